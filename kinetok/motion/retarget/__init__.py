"""Foreign skeletons onto characters: `retarget` and its results."""

from kinetok.motion.retarget.report import RetargetReport
from kinetok.motion.retarget.run import Retargeted, retarget

__all__ = ["RetargetReport", "Retargeted", "retarget"]
