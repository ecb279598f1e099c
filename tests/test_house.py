"""The import law: which room may import what. `violations` reads a source tree; it imports nothing of it."""

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "kinetok"

GROUND = {"config", "checkpoint", "rotation", "metrics", "logger", "resume"}
FRONT = {"demo", "evaluate", "presets", "render"}
BELOW = {
    "ground": set(),
    "motion": {"ground"},
    "sim": {"ground", "motion"},
    "rl": {"ground"},
    "tokenizers": {"ground", "motion", "sim", "rl"},
    "gpt": {"ground", "motion", "sim", "rl", "tokenizers"},
    "adapters": {"ground", "motion", "sim", "rl", "tokenizers", "gpt"},
    "front": {"ground", "motion", "sim", "rl", "tokenizers", "gpt", "adapters"},
    "cli": {"ground", "motion", "sim", "rl", "tokenizers", "gpt", "adapters", "front"},
}
PURE = {
    "tokenizers": {"quantizer", "fsq", "vq", "rvq", "categorical", "gaussian", "spherical", "layout"},
    "gpt": {"model", "cache", "replay", "sample"},
    "adapters": {"lora", "dora", "cola", "full", "inject"},
}
OUTSIDE = {"torch", "numpy", "einops"}
BORDERS = {  # files, or whole rooms
    "mujoco.batch": {"motion/kinematics.py", "sim/batch.py"},
    "click": {"cli"},
    "sentencepiece": {"tokenizers/pieces.py"},
    "safetensors": {"checkpoint.py"},
    "pickle": set(),
    "cloudpickle": set(),
    "torch.load": set(),
    "torch.save": set(),
    "importlib.import_module": set(),
}
EXTRAS = {
    "gymnasium",
    "tensorboard",
    "torch.utils.tensorboard",
    "mink",
    "daqp",
    "mujoco_menagerie",
    "mujoco_warp",
    "wandb",
    "huggingface_hub",
}
EXTRAS |= {"onnx", "onnxruntime", "onnxscript"}


def violations(package: Path) -> list[str]:
    """Lines "file:line: what is wrong" for every breach of the law in the package at this directory."""
    found = []
    for path in sorted(package.rglob("*.py")):
        name = path.relative_to(package).as_posix()
        tree = ast.parse(path.read_text(encoding="utf-8"))
        if not ast.get_docstring(tree):
            found.append(f"{name}:1: has no docstring")
        for node, lazy in imports(tree):
            for target in targets(node, package, name):
                found += [f"{name}:{node.lineno}: {wrong}" for wrong in judge(name, target, lazy)]
        for node in ast.walk(tree):
            target = ast.unparse(node) if isinstance(node, ast.Attribute) else ""
            if target in BORDERS and not BORDERS[target] & {name, name.split("/")[0]}:
                found.append(f"{name}:{node.lineno}: uses {target}")  # type: ignore[attr-defined]
    return found


def imports(tree: ast.AST, lazy: bool = False) -> Iterator[tuple[ast.Import | ast.ImportFrom, bool]]:
    """Every import statement, and whether it stands inside a function."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node, lazy
        yield from imports(node, lazy or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))


def targets(node: ast.Import | ast.ImportFrom, package: Path, name: str) -> list[str]:
    """Dotted names of what is imported; `from a import b` is a.b where that can be a module, else a."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    here = ["kinetok", *Path(name).parts[:-1]]
    above = ".".join(here[: len(here) - node.level + 1]) if node.level else ""
    base = ".".join(part for part in (above, node.module) if part)
    full = [f"{base}.{alias.name}" for alias in node.names]
    return [target if is_module(target, package) else base for target in full]


def is_module(target: str, package: Path) -> bool:
    head, *rest = target.split(".")
    path = package.joinpath(*rest)
    return path.is_dir() or path.with_suffix(".py").is_file() if head == "kinetok" else target in BORDERS


def judge(name: str, target: str, lazy: bool) -> list[str]:
    """What is wrong with the file `name` importing `target`."""
    here, stem = room(name.removesuffix(".py").split("/")), Path(name).stem
    pure = stem in PURE.get(here, ())
    wrong = []
    if here not in BELOW:
        wrong.append(f"stands on no known floor ({here})")
    for border, rooms in BORDERS.items():
        if (target == border or target.startswith(border + ".")) and not rooms & {name, name.split("/")[0]}:
            wrong.append(f"imports {target}, which only {', '.join(sorted(rooms)) or 'no file'} may")
    extra = any(target == known or target.startswith(known + ".") for known in EXTRAS)
    if lazy and here != "cli" and not extra:
        wrong.append(f"imports {target} inside a function")
    if target.split(".")[0] != "kinetok":
        top = target.split(".")[0]
        if pure and top not in OUTSIDE | sys.stdlib_module_names:
            wrong.append(f"is pure and may not import {target}")
        if here in ("ground", "rl") and top in ("mujoco", "gymnasium"):
            wrong.append(f"knows no simulator and may not import {target}")
        return wrong
    there, sibling = room(target.split(".")[1:]), target.rpartition(".")[2]
    if there != here and there not in BELOW.get(here, ()):
        wrong.append(f"may not import {target} ({there} is not below {here})")
    elif pure and there != "ground" and not (there == here and sibling in PURE[here]):
        wrong.append(f"is pure and may not import {target}")
    return wrong


def room(parts: list[str]) -> str:
    """The floor of a module, from its path below the package."""
    if not parts or parts[0] == "__init__" or parts[0] in GROUND:
        return "ground"
    return "front" if parts[0] in FRONT else "cli" if parts[0] == "__main__" else parts[0]


def test_the_package_keeps_the_law():
    assert violations(PACKAGE) == []


def test_what_the_package_imports_is_installed_with_it():
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    installed = {re.split(r"[<>=]", line)[0].replace("-", "_") for line in project["dependencies"]}
    for path in PACKAGE.rglob("*.py"):
        for node, _ in imports(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module or "kinetok"]
            tops = {name.partition(".")[0] for name in names if name not in EXTRAS}
            missing = tops - installed - EXTRAS - sys.stdlib_module_names - {"kinetok"}
            assert not missing, f"{path.name}:{node.lineno}: {missing} is no dependency of the project"


def plant(root: Path, files: dict[str, str]) -> Path:
    tree = dict.fromkeys(
        [
            "__init__.py",
            "config.py",
            "motion/clip.py",
            "sim/env.py",
            "rl/ppo.py",
            "gpt/__init__.py",
            "gpt/model.py",
            "gpt/cache.py",
            "gpt/data.py",
            "tokenizers/fsq.py",
            "tokenizers/train.py",
        ],
        "",
    )
    for name, text in (tree | files).items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(f'"""Planted."""\n{text}\n')
    return root


def test_lawful_imports_pass(tmp_path):
    lawful = {
        "gpt/model.py": "import math\nimport torch\nfrom kinetok import config\nfrom .cache import Cache",
        "gpt/data.py": "from kinetok.motion import clip\nfrom kinetok.tokenizers.train import fit",
        "logger.py": "def board():\n    from torch.utils.tensorboard import SummaryWriter",
        "cli/clips.py": "import click\ndef main():\n    from kinetok.gpt import data",
        "sim/batch.py": "from mujoco import batch\nimport mujoco.batch",
    }
    assert violations(plant(tmp_path, lawful)) == []


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("sim/env.py", "from kinetok.rl import ppo", "may not import kinetok.rl.ppo (rl is not below sim)"),
        ("rl/ppo.py", "import kinetok.sim.env", "may not import kinetok.sim.env (sim is not below rl)"),
        ("rl/ppo.py", "from kinetok.motion.clip import Clip", "(motion is not below rl)"),
        ("rl/ppo.py", "import mujoco", "knows no simulator and may not import mujoco"),
        (
            "motion/clip.py",
            "from ..sim.env import Env",
            "may not import kinetok.sim.env (sim is not below motion)",
        ),
        (
            "config.py",
            "from kinetok import motion",
            "may not import kinetok.motion (motion is not below ground)",
        ),
        ("evaluate.py", "from kinetok.cli import main", "(cli is not below front)"),
        (
            "tokenizers/fsq.py",
            "from kinetok.motion import clip",
            "is pure and may not import kinetok.motion.clip",
        ),
        (
            "tokenizers/fsq.py",
            "from .train import fit",
            "is pure and may not import kinetok.tokenizers.train",
        ),
        ("gpt/model.py", "from kinetok.gpt import data", "is pure and may not import kinetok.gpt.data"),
        (
            "gpt/model.py",
            "from kinetok.tokenizers import fsq",
            "is pure and may not import kinetok.tokenizers.fsq",
        ),
        ("gpt/model.py", "import rich", "is pure and may not import rich"),
        (
            "sim/env.py",
            "from mujoco import batch",
            "imports mujoco.batch, which only motion/kinematics.py, sim/batch.py",
        ),
        ("sim/env.py", "import mujoco\nmujoco.batch.Batch()", "env.py:3: uses mujoco.batch"),
        ("sim/env.py", "from mujoco.batch import Batch", "imports mujoco.batch, which only"),
        (
            "gpt/data.py",
            "from safetensors.torch import save_file",
            "which only checkpoint.py may",
        ),
        ("presets.py", "import click", "imports click, which only cli may"),
        ("gpt/data.py", "import pickle", "imports pickle, which only no file may"),
        ("gpt/data.py", "import torch\ntorch.save({}, 'x')", "data.py:3: uses torch.save"),
        ("gpt/data.py", "from torch import load", "imports torch.load"),
        ("gpt/data.py", "def f():\n    import json", "imports json inside a function"),
        (
            "gpt/data.py",
            "class A:\n    async def f(self):\n        import json",
            "imports json inside a function",
        ),
        ("attic/tools.py", "import json", "stands on no known floor (attic)"),
    ],
)
def test_a_planted_violation_is_found(tmp_path, name, text, message):
    (found,) = violations(plant(tmp_path, {name: text}))
    assert found.startswith(name) and message in found


def test_a_module_without_a_docstring_is_found(tmp_path):
    (plant(tmp_path, {}) / "motion" / "clip.py").write_text("x = 1\n")
    assert violations(tmp_path) == ["motion/clip.py:1: has no docstring"]
