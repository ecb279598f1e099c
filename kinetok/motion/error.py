"""The one error of every reader: which file, where in it, what is wrong."""

from pathlib import Path


class FormatError(ValueError):
    """A motion file that cannot be read: `path`, `where` (line, frame, column or key) and the reason."""

    def __init__(self, path: Path, where: str, reason: str):
        super().__init__(f"{path}: {where}: {reason}")
        self.path, self.where = path, where
