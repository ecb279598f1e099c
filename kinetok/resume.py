"""What a training writes down so that a later call goes on where it was, bit for bit.

    state = State(out, {"student": student, "optimizer": optimizer, "draws": generator},
                  identity=identity, kinds={"stage": DistillStage})
    before = state.restore()                       # None, or the meta and what else was kept
    state.save({"step": step}, memory=memory)

The file is `out`/state.safetensors. `identity` says which run it is of: another one is refused, saying what differs.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import torch

from kinetok.checkpoint import CheckpointError, flatten, load_state, save_state, unflatten
from kinetok.config import ConfigError, diff, from_dict, to_dict


class Part(Protocol):
    """What a run changes, as far as saving goes; any nn.Module or optimizer is one."""

    def state_dict(self) -> dict[str, Any]: ...
    def load_state_dict(self, state: dict[str, Any], /) -> Any: ...


class State:
    """parts: what is saved and restored, by name, generators of random numbers among them (torch.default_generator
    for what is drawn without one); identity: what a run must share with another to go on from it (JSON); kinds:
    classes of the configs in it, see `refuse_changed`."""

    def __init__(
        self,
        out: Path,
        parts: Mapping[str, Part | torch.Generator],
        *,
        identity: dict[str, Any],
        kinds: Mapping[str, type],
        name: str = "state",
    ):
        self.path, self.parts, self.identity, self.kinds = out / f"{name}.safetensors", parts, identity, kinds

    def restore(self) -> tuple[dict[str, Any], dict[str, Any]] | None:
        """Bring every part to where it was saved; the meta and what else was kept, or None where there is no state.

        Raises CheckpointError for the state of another run, before any part is touched.
        """
        if not self.path.exists():
            return None
        tensors, meta = load_state(self.path)
        refuse_changed(self.path, meta["identity"], self.identity, self.kinds)
        tree = unflatten(tensors, meta["tree"])
        for name, part in self.parts.items():
            before = tree.pop(name)
            if isinstance(part, torch.Generator):
                part.set_state(before.cpu())
            else:
                part.load_state_dict(before)
        return meta, tree

    def save(self, meta: dict[str, Any], **kept: Any) -> None:
        """Write the parts, JSON-able meta, and trees of tensors and numbers by name."""
        tree = {name: _state_of(part) for name, part in self.parts.items()}
        tensors, skeleton = flatten(tree | kept)
        save_state(self.path, tensors, {"tree": skeleton, "identity": self.identity} | meta)


def _state_of(part: Part | torch.Generator) -> Any:
    return part.get_state() if isinstance(part, torch.Generator) else dict(part.state_dict())


def refuse_changed(path: Path, old: dict, new: dict, kinds: Mapping[str, type]) -> None:
    """Raise CheckpointError where the state at `path` is of another run, by its identity.

    kinds: the config class behind keys of the identity: a setting that the old one does not know had its default.
    A longer run is the same run: where both say `stage.samples`, the new one may be larger.
    """
    missing = [key for key in kinds if key not in old]
    if missing:
        raise CheckpointError(
            f"{path} is the state of another kind of run: it has no {missing[0]}; choose another --out"
        )
    try:
        old = old | {key: to_dict(from_dict(kind, old[key], key)) for key, kind in kinds.items()}
    except ConfigError as error:
        raise CheckpointError(
            f"{path} is the state of another kind of run, or of another version of kinetok ({error}); "
            "choose another --out"
        ) from error
    before, now = old.get("stage", {}).get("samples", 0), new.get("stage", {}).get("samples", 0)
    if now > before:
        old["stage"] = old["stage"] | {"samples": now}
    changed = diff(old, new)
    if changed:
        raise CheckpointError(
            f"{path}: this run was started with another configuration: {'; '.join(changed)}. "
            "Repeat the old settings to go on, or choose another --out"
        )
