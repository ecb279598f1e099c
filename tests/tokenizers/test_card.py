"""card.py: the table of clips, by hand."""

import io

import numpy as np
from rich.console import Console

from kinetok.tokenizers.card import clip_table


def test_the_table_puts_the_hardest_clip_first_and_says_what_is_not_known():
    student, teacher = np.array([[1, 30.4], [0.5, 99], [1, 40]]), np.array([[1, 20], [np.nan] * 2, [0, 9]])
    console = Console(file=io.StringIO(), width=100)
    console.print(clip_table(("a", "b", "c"), {"distill": student, "teacher": teacher}))
    lines = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert "distill: success" in lines[1] and "teacher: success" in lines[1]
    rows = ["".join(line.split()) for line in lines[3:-1]]
    assert rows == ["│b│50%│99│-│-│", "│c│100%│40│0%│9│", "│a│100%│30│100%│20│"]
