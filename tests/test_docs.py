"""The snippets of docs/api.md run in order, as the page says, from a folder that holds a walk; links lead somewhere."""

import re
import shutil
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WALK = ROOT.parent / "shared" / "data" / "train" / "deepmimic" / "humanoid3d_walk.txt"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def test_the_python_page_runs_from_top_to_bottom(tmp_path, monkeypatch):
    if not WALK.exists():
        pytest.skip(f"needs the DeepMimic walk at {WALK}")
    shutil.copy(WALK, tmp_path / "walk.txt")
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    names: dict = {}
    for snippet in re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL):
        exec(snippet, names)
    assert names["stream"].tokens.shape == (120, 5) and not names["stream"].lost
    assert names["qpos"].shape == (121, 43) and names["played"].qpos.shape == (240, 1, 43)
    assert names["obs"].shape[0] == len(names["reward"]) == 64 and names["reward"].mean() > 0.3


def heading(line: str) -> str:
    """The anchor of a heading."""
    return re.sub(r"[^a-z0-9 _-]", "", line.lstrip("#").strip().lower()).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    text = page.read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)#\s]*)(#[^)\s]*)?\)", text):
        target, anchor = link
        if target.startswith("http"):
            continue
        place = (page.parent / target) if target else page
        assert place.exists(), f"{page.name}: {target}"
        if anchor:
            found = {heading(line) for line in place.read_text(encoding="utf-8").splitlines() if line.startswith("#")}
            assert anchor[1:] in found, f"{page.name}: {target}{anchor}"
