"""Motion made visible: frames, videos and strips of stills. It draws poses; it does not simulate."""

from kinetok.render.video import FROM_ABOVE, RenderError, render_frames, write_strip, write_video

__all__ = ["FROM_ABOVE", "RenderError", "render_frames", "write_strip", "write_video"]
