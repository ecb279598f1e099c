"""What a training run leaves behind: artifacts to share, and states to resume from. No pickle.

An artifact is a directory of three files:

    config.json         "kinetok" (version), "kind", "hash" (sha256 of model.safetensors), "parents", "config"
    model.safetensors   the tensors
    README.md           the model card

    save_artifact(out, kind="gpt", config=to_dict(config), tensors=model.state_dict(), card=card,
                  parents={"tokenizer": tokenizer.hash})
    artifact = load_artifact(out, "gpt")

An adapter has peft's file names instead, adapter_config.json and adapter_model.safetensors: files=ADAPTER.

A state is one file that holds any nest of dicts, lists, tuples, tensors and scalars:

    tensors, skeleton = flatten(optimizer.state_dict())
    save_state(out / "state.safetensors", tensors, {"optimizer": skeleton, "iteration": 40})

Every file is written beside its place, synced and renamed, config.json last: a reader sees the old file or
the new one, and a save cut short between files is found by the hash. Refuses to overwrite files of these
names that kinetok did not write, and to load what is missing, edited, of another kind or from a newer major
version. Other files in the directory are left alone. Knows nothing of what the tensors mean.
"""

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from kinetok import __version__
from kinetok.config import nearest

CARD = "README.md"
PACKAGED = Path(__file__).parent / "assets"
Tensors = dict[str, torch.Tensor]

# safetensors writes metadata in random order: with a second key, equal tensors would have different hashes.
STAMP = {"kinetok": "artifact"}


class CheckpointError(RuntimeError):
    """A file or directory that cannot be saved to or loaded from; the message names it and the remedy."""


@dataclass(frozen=True, kw_only=True)
class Files:
    """config, model: file names in an artifact directory, beside its README.md."""

    config: str
    model: str


MODEL = Files(config="config.json", model="model.safetensors")
ADAPTER = Files(config="adapter_config.json", model="adapter_model.safetensors")


@dataclass(frozen=True, kw_only=True)
class Artifact:
    """A loaded artifact.

    path: its directory. kind: what it is, such as "gpt". config: JSON of its config. tensors: by name, on the
    CPU. parents: role -> hash of the artifact it was made from. hash: sha256 of model.safetensors, in hex.
    """

    path: Path
    kind: str
    config: dict[str, Any]
    tensors: Tensors
    parents: dict[str, str]
    hash: str


def save_artifact(
    path: Path | str,
    *,
    kind: str,
    config: dict[str, Any],
    tensors: Tensors,
    card: str,
    parents: dict[str, str] | None = None,
    files: Files = MODEL,
    extra: dict[str, Any] | None = None,
) -> Path:
    """Write an artifact directory, replacing the artifact there if there is one; returns its path.

    parents: role -> hash of each artifact this one depends on, checked later by `require_parent`. files: its names.
    extra: further top-level keys of the config file, for other programs; `load_artifact` does not read them.
    """
    path = Path(path)
    refuse_foreign(path, kind, files)
    header = {"kinetok": __version__, "kind": kind, "hash": "", "parents": parents or {}, "config": config}
    taken = header.keys() & (extra or {}).keys()
    if taken:
        raise ValueError(f"extra may not hold {', '.join(sorted(taken))}: kinetok writes these keys itself")
    header |= extra or {}
    _check_json(header, "config")
    path.mkdir(parents=True, exist_ok=True)
    header["hash"] = _write(path / files.model, lambda file: save_file(_owned(tensors), file, STAMP))
    _write(path / CARD, lambda file: file.write_text(card, encoding="utf-8"))
    text = json.dumps(header, indent=2) + "\n"
    _write(path / files.config, lambda file: file.write_text(text, encoding="utf-8"))
    return path


def load_artifact(path: Path | str, kind: str | None = None, files: Files = MODEL) -> Artifact:
    """Read and verify an artifact. kind: what it must be; None accepts any. files: its names.

    path: its directory, or the name of one that comes with kinetok (`packaged()` lists them).
    """
    path = locate(path, files)
    header = _read_header(path, files)
    if kind is not None and header["kind"] != kind:
        raise CheckpointError(f"{path} is a {header['kind']!r}; a {kind!r} was asked for")
    model = path / files.model
    if not model.is_file():
        raise CheckpointError(f"{path} has no {files.model}; copy the whole directory again")
    found = _sha256(model)
    if found != header["hash"]:
        said = f"its hash is {found[:12]}, {files.config} says {header['hash'][:12]}"
        raise CheckpointError(f"{model} is truncated or edited: {said}; copy or save it again")
    tensors, _ = _read_tensors(model)
    return Artifact(
        path=path,
        kind=header["kind"],
        config=header["config"],
        tensors=tensors,
        parents=header["parents"],
        hash=found,
    )


def packaged(files: Files = MODEL) -> list[str]:
    """Names of the artifacts with these file names that come with kinetok."""
    return sorted(entry.parent.name for entry in PACKAGED.glob(f"*/{files.config}"))


def locate(path: Path | str, files: Files = MODEL) -> Path:
    """The directory itself where it exists, else the packaged artifact of that name."""
    path = Path(path)
    if path.is_dir() or path.parent != Path():
        return path
    if path.name in packaged(files):
        return PACKAGED / path.name
    return path


def require_parent(artifact: Artifact, role: str, parent_hash: str, parent_path: Path | str) -> None:
    """Raise unless `artifact` was made with the artifact of this hash, at `parent_path`, as its `role`."""
    if role not in artifact.parents:
        known = ", ".join(artifact.parents) or "(none)"
        raise CheckpointError(f"{artifact.path} records no parent {role!r}; it records: {known}")
    expected = artifact.parents[role]
    if expected != parent_hash:
        raise CheckpointError(
            f"{artifact.path} was made with the {role} {expected[:12]}, "
            f"but {parent_path} is {parent_hash[:12]}; load the {role} it was made with"
        )


def save_state(path: Path | str, tensors: Tensors, meta: dict[str, Any]) -> None:
    """Write tensors and JSON-able `meta` to one file, atomically. Trees go through `flatten` first."""
    path = Path(path)
    _check_json(meta, "meta")
    stamp = {"kinetok": __version__, "meta": json.dumps(meta)}
    path.parent.mkdir(parents=True, exist_ok=True)
    _write(path, lambda file: save_file(_owned(tensors), file, stamp))


def load_state(path: Path | str) -> tuple[Tensors, dict[str, Any]]:
    """The tensors, on torch's default device, and meta that `save_state` wrote."""
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"{path} does not exist; there is no state to resume from")
    tensors, stamp = _read_tensors(path)
    if "kinetok" not in stamp or "meta" not in stamp:
        raise CheckpointError(f"{path} is a safetensors file, but not a kinetok state")
    _refuse_newer(path, stamp["kinetok"])
    return tensors, json.loads(stamp["meta"])


def flatten(tree: Any) -> tuple[Tensors, Any]:
    """Split a nest of dicts, lists, tuples, tensors and scalars into named tensors and a JSON-able skeleton.

    Dict keys may be str, int, float, bool or None; floats return bit for bit (NaN as NaN).
    """
    tensors: Tensors = {}
    return tensors, _skeleton(tree, "tree", tensors)


def unflatten(tensors: Tensors, skeleton: Any) -> Any:
    """The tree that `flatten` split."""
    if isinstance(skeleton, list):
        return [unflatten(tensors, item) for item in skeleton]
    if not isinstance(skeleton, dict):
        return skeleton
    ((tag, value),) = skeleton.items()
    if tag == "tensor":
        if value not in tensors:
            raise CheckpointError(f"the skeleton names a tensor {value!r} that is absent{nearest(value, tensors)}")
        return tensors[value]
    if tag == "tuple":
        return tuple(unflatten(tensors, item) for item in value)
    return {key: unflatten(tensors, item) for key, item in value}


def _skeleton(tree: Any, name: str, tensors: Tensors) -> Any:
    if isinstance(tree, torch.Tensor):
        while name in tensors:  # the keys 0 and "0" of one dict would share a name
            name += "'"
        tensors[name] = tree
        return {"tensor": name}
    if tree is None or type(tree) in (bool, int, float, str):
        return tree
    if type(tree) in (list, tuple):
        items = [_skeleton(item, f"{name}.{i}", tensors) for i, item in enumerate(tree)]
        return items if isinstance(tree, list) else {"tuple": items}
    if isinstance(tree, dict):
        for key in tree:
            if key is not None and type(key) not in (bool, int, float, str):
                raise ValueError(f"{name}: a dict key may be str, int, float, bool or None, not {key!r}")
        return {"dict": [[key, _skeleton(item, f"{name}.{key}", tensors)] for key, item in tree.items()]}
    raise ValueError(f"{name}: cannot save a {type(tree).__name__}; use tensors, dicts, lists, tuples and scalars")


def _check_json(value: Any, where: str) -> None:
    """Refuse what JSON would change without saying so: tuples, keys that are not strings, foreign types."""
    if isinstance(value, dict):
        for key, item in value.items():
            if not isinstance(key, str):
                raise ValueError(f"{where}: the key {key!r} is not a string; pass the tree through flatten()")
            _check_json(item, f"{where}.{key}")
    elif isinstance(value, list):
        for i, item in enumerate(value):
            _check_json(item, f"{where}[{i}]")
    elif value is not None and type(value) not in (bool, int, float, str):
        raise ValueError(f"{where}: {value!r} has no exact JSON form; pass it through to_dict() or flatten()")


def _owned(tensors: Tensors) -> Tensors:
    """Contiguous CPU tensors of which no two share memory, as safetensors wants them."""
    owned: Tensors = {}
    seen: set[int] = set()
    for name, tensor in tensors.items():
        tensor = tensor.detach().cpu().contiguous()
        pointer = tensor.untyped_storage().data_ptr()
        owned[name] = tensor.clone() if pointer in seen else tensor
        seen.add(pointer)
    return owned


def _write(path: Path, write: Callable[[Path], object]) -> str:
    """Have `write` make a file beside `path`, sync it and rename it into place; returns its sha256."""
    draft = path.with_name(f".{path.name}.tmp")
    try:
        write(draft)
        with open(draft, "rb+") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
            os.fsync(file.fileno())
        draft.chmod(0o644)  # safetensors makes files that only their owner can read
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)
    _sync_directory(path.parent)
    return digest


def _sync_directory(path: Path) -> None:
    if os.name == "nt":  # Windows cannot open a directory
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def refuse_foreign(path: Path, kind: str, files: Files = MODEL) -> None:
    """Refuse to write an artifact of this kind over a file, over one of another kind, or over a config, model or
    README.md of these names that is not ours."""
    if path.exists() and not path.is_dir():
        raise CheckpointError(f"{path} is a file; an artifact is a directory, choose another path")
    for other in (MODEL, ADAPTER):
        found = _kind(path / other.config)
        if found not in ("", kind):
            raise CheckpointError(f"{path} holds a {found!r}, which a {kind!r} would replace; choose another directory")
    present = [name for name in (files.config, files.model, CARD) if (path / name).exists()]
    if present and not _is_ours(path, files):
        raise CheckpointError(
            f"{path} holds a {present[0]} that kinetok did not write; choose an empty or new directory"
        )


def _kind(config: Path) -> str:
    """Of the artifact whose config file that is; nothing where it is none of ours."""
    try:
        header = json.loads(config.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return ""
    return str(header.get("kind", "")) if isinstance(header, dict) and "kinetok" in header else ""


def _is_ours(path: Path, files: Files) -> bool:
    # A first save cut short has left the tensors, which are stamped, and no config.
    try:
        if (path / files.config).exists():
            header = json.loads((path / files.config).read_text(encoding="utf-8"))
            return isinstance(header, dict) and "kinetok" in header
        with safe_open(path / files.model, "pt") as file:
            return "kinetok" in (file.metadata() or {})
    except (OSError, ValueError, SafetensorError):
        return False


def _read_header(path: Path, files: Files) -> dict[str, Any]:
    if not path.is_dir():
        siblings = [entry.name for entry in path.parent.iterdir()] if path.parent.is_dir() else []
        names = packaged(files) if path.parent == Path() else []
        if path.parent == Path() and path.name in [*packaged(MODEL), *packaged(ADAPTER)]:
            other = _kind(PACKAGED / path.name / (MODEL if path.name in packaged(MODEL) else ADAPTER).config)
            raise CheckpointError(f"the packaged {path} is a {other!r}; of the kind asked for: {', '.join(names)}")
        known = f"; packaged: {', '.join(names)}" if names else ""
        raise CheckpointError(f"there is no directory {path}{nearest(path.name, siblings + names)}{known}")
    config = path / files.config
    if not config.is_file():
        raise CheckpointError(f"{path} has no {files.config}; it is not an artifact, or its first save was cut short")
    try:
        header = json.loads(config.read_text(encoding="utf-8"))
    except ValueError as error:
        raise CheckpointError(f"{config} is not valid JSON ({error}); copy or save it again") from error
    _check_header(config, header)
    return header


def _check_header(path: Path, header: Any) -> None:
    """Refuse the content `header` of the config file at `path` unless `save_artifact` wrote it."""
    wanted = {"kinetok": str, "kind": str, "hash": str, "parents": dict, "config": dict}
    if not isinstance(header, dict) or "kinetok" not in header:
        raise CheckpointError(f"{path} was not written by kinetok: it has no key 'kinetok'")
    for key, kind in wanted.items():
        if not isinstance(header.get(key), kind):
            raise CheckpointError(f"{path}: {key!r} is missing or not a {kind.__name__}; save it again")
    _refuse_newer(path, header["kinetok"])


def _refuse_newer(path: Path, version: str) -> None:
    major = version.split(".")[0]
    if not major.isdecimal():
        raise CheckpointError(f"{path}: cannot read the kinetok version {version!r}")
    if int(major) > int(__version__.split(".")[0]):
        raise CheckpointError(f"{path} was written by kinetok {version}, this is {__version__}; upgrade kinetok")


def _read_tensors(path: Path) -> tuple[Tensors, dict[str, str]]:
    try:
        with safe_open(path, "pt", device=str(torch.get_default_device())) as file:
            return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118
    except SafetensorError as error:
        raise CheckpointError(f"{path} is not a safetensors file ({error}); copy or save it again") from error
