"""Motion made visible: frames, videos and strips of stills. It draws poses; it does not simulate."""

from kinetok.render.video import RenderError, render_frames, render_task, write_strip, write_video

__all__ = ["RenderError", "render_frames", "render_task", "write_strip", "write_video"]
