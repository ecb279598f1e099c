"""checkpoint.py: round trips bit for bit, what a cut-short or foreign write does, messages."""

import hashlib
import json
import math

import pytest
import torch

from kinetok.checkpoint import (
    ADAPTER,
    CheckpointError,
    flatten,
    load_artifact,
    load_state,
    require_parent,
    save_artifact,
    save_state,
    unflatten,
)

CONFIG = {"layers": 2, "rate": 0.1, "future": [1, 2]}


def save(path, value=1.0, **changes):
    arguments = {
        "kind": "gpt",
        "config": CONFIG,
        "tensors": {"w": torch.full((2, 3), value)},
        "card": "# Card\n",
    }
    return save_artifact(path, **(arguments | changes))


def test_artifact_round_trip(tmp_path):
    base = torch.arange(6.0).reshape(2, 3)
    tensors = {
        "a": base,
        "shared": base,
        "row": base[1],
        "transposed": base.T,
        "ids": torch.tensor([2**60]),
        "half": torch.tensor([1.5], dtype=torch.bfloat16),
        "scalar": torch.tensor(3.0),
        "empty": torch.empty(0, 4),
        "empty too": torch.empty(0),
        "grad": torch.ones(2, requires_grad=True),
    }
    path = save(tmp_path / "deep" / "run", tensors=tensors, parents={"tokenizer": "ab" * 32})
    artifact = load_artifact(path, "gpt")
    assert (artifact.kind, artifact.config, artifact.path) == ("gpt", CONFIG, path)
    assert artifact.parents == {"tokenizer": "ab" * 32}
    assert artifact.tensors.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert artifact.tensors[name].dtype == tensor.dtype and torch.equal(artifact.tensors[name], tensor)
    assert sorted(file.name for file in path.iterdir()) == ["README.md", "config.json", "model.safetensors"]


def test_saving_again_replaces_the_artifact_and_keeps_other_files(tmp_path):
    first = load_artifact(save(tmp_path))
    (tmp_path / "metrics.jsonl").write_text("kept")
    second = load_artifact(save(tmp_path, value=2.0, card="new"))
    assert second.hash != first.hash and second.tensors["w"][0, 0] == 2
    assert (tmp_path / "metrics.jsonl").read_text() == "kept"
    assert (tmp_path / "README.md").read_text() == "new"


def test_an_adapter_has_other_file_names_and_keys_for_other_programs(tmp_path):
    path = save(tmp_path, files=ADAPTER, extra={"peft_type": "LORA", "r": 8})
    assert sorted(file.name for file in path.iterdir()) == [
        "README.md",
        "adapter_config.json",
        "adapter_model.safetensors",
    ]
    artifact = load_artifact(path, "gpt", ADAPTER)
    assert artifact.config == CONFIG and torch.equal(artifact.tensors["w"], torch.ones(2, 3))
    header = json.loads((path / "adapter_config.json").read_text())
    assert (header["peft_type"], header["r"]) == ("LORA", 8)
    with pytest.raises(CheckpointError, match=r"has no config\.json"):
        load_artifact(path)
    with pytest.raises(CheckpointError, match=r"holds a README\.md that kinetok did not write"):
        save(path)  # an artifact of the other kind may not take over the card
    with pytest.raises(ValueError, match="extra may not hold hash, kind: kinetok writes these keys itself"):
        save(path, files=ADAPTER, extra={"kind": "x", "hash": "y"})
    (path / "adapter_model.safetensors").write_bytes(b"cut")
    with pytest.raises(CheckpointError, match=r"adapter_model\.safetensors is truncated or edited: .* adapter_config"):
        load_artifact(path, "gpt", ADAPTER)


def test_the_hash_depends_on_the_tensors_only(tmp_path):
    tensors = {name: torch.ones(2) for name in "abcdef"}
    saves = [save(tmp_path / str(i), tensors=tensors, card=f"{i}", config={"i": i}) for i in range(8)]
    assert len({load_artifact(path).hash for path in saves}) == 1


def test_a_first_save_cut_short_can_be_repeated(tmp_path):
    save(tmp_path)
    (tmp_path / "config.json").unlink()
    with pytest.raises(CheckpointError, match=r"has no config\.json; it is not an artifact, or its first save"):
        load_artifact(tmp_path)
    assert load_artifact(save(tmp_path)).kind == "gpt"


def test_a_failed_save_leaves_the_old_artifact(tmp_path):
    before = load_artifact(save(tmp_path)).hash
    for bad in ({"tensors": {"w": torch.ones(2).to_sparse()}}, {"config": {"future": (1, 2)}}):
        with pytest.raises((ValueError, RuntimeError)):
            save(tmp_path, **bad)
    assert load_artifact(tmp_path).hash == before
    assert len(list(tmp_path.iterdir())) == 3


def edit(path, **changes):
    header = json.loads((path / "config.json").read_text()) | changes
    (path / "config.json").write_text(json.dumps(header))


def truncate(path):
    (path / "model.safetensors").write_bytes((path / "model.safetensors").read_bytes()[:-1])


def garble(path):
    (path / "model.safetensors").write_bytes(b"not tensors")
    edit(path, hash=hashlib.sha256(b"not tensors").hexdigest())


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: (path / "config.json").unlink(), "has no config.json"),
        (
            lambda path: (path / "model.safetensors").unlink(),
            "has no model.safetensors; copy the whole directory",
        ),
        (lambda path: (path / "config.json").write_text("{"), "is not valid JSON"),
        (
            lambda path: (path / "config.json").write_text("{}"),
            "was not written by kinetok: it has no key 'kinetok'",
        ),
        (lambda path: edit(path, config=3), "'config' is missing or not a dict; save it again"),
        (lambda path: edit(path, kind="tokenizer"), "is a 'tokenizer'; a 'gpt' was asked for"),
        (lambda path: edit(path, kinetok="7.0.0"), "was written by kinetok 7.0.0, this is"),
        (lambda path: edit(path, kinetok="new"), "cannot read the kinetok version 'new'"),
        (truncate, "model.safetensors is truncated or edited: its hash is"),
        (garble, "model.safetensors is not a safetensors file"),
    ],
)
def test_load_messages(tmp_path, damage, message):
    path = save(tmp_path / "run")
    damage(path)
    with pytest.raises(CheckpointError) as error:
        load_artifact(path, "gpt")
    assert message in str(error.value) and str(path) in str(error.value)


def test_a_missing_directory_is_answered_with_the_nearest(tmp_path):
    save(tmp_path / "tracker")
    with pytest.raises(CheckpointError, match=r"there is no directory .*trakcer; did you mean 'tracker'\?"):
        load_artifact(tmp_path / "trakcer")


@pytest.mark.parametrize("name", ["config.json", "model.safetensors", "README.md"])
def test_files_of_others_are_not_overwritten(tmp_path, name):
    (tmp_path / name).write_text("{}")
    with pytest.raises(CheckpointError, match=f"holds a {name} that kinetok did not write; choose"):
        save(tmp_path)
    assert (tmp_path / name).read_text() == "{}"


def test_a_file_is_no_place_for_an_artifact(tmp_path):
    (tmp_path / "run").write_text("")
    with pytest.raises(CheckpointError, match="run is a file; an artifact is a directory"):
        save(tmp_path / "run")


def test_require_parent(tmp_path):
    artifact = load_artifact(save(tmp_path, parents={"tokenizer": "a" * 64}))
    require_parent(artifact, "tokenizer", "a" * 64, "runs/tok")
    with pytest.raises(CheckpointError, match="made with the tokenizer aaaaaaaaaaaa, but runs/tok is bbbbbbbbbbbb;"):
        require_parent(artifact, "tokenizer", "b" * 64, "runs/tok")
    with pytest.raises(CheckpointError, match="records no parent 'tracker'; it records: tokenizer"):
        require_parent(artifact, "tracker", "a" * 64, "runs/tok")


def test_state_round_trips_an_optimizer(tmp_path):
    def make():
        torch.manual_seed(0)
        layer = torch.nn.Linear(3, 2)
        return layer, torch.optim.AdamW(layer.parameters(), lr=0.1, betas=(0.8, 0.99))

    def step(layer, optimizer):
        optimizer.zero_grad()
        layer(torch.ones(1, 3)).square().sum().backward()
        optimizer.step()

    layer, optimizer = make()
    step(layer, optimizer)
    tensors, skeleton = flatten({"layer": layer.state_dict(), "optimizer": optimizer.state_dict()})
    save_state(tmp_path / "state.safetensors", tensors, {"tree": skeleton, "iteration": 1})
    step(layer, optimizer)

    tensors, meta = load_state(tmp_path / "state.safetensors")
    tree = unflatten(tensors, meta["tree"])
    other, resumed = make()
    other.load_state_dict(tree["layer"])
    resumed.load_state_dict(tree["optimizer"])
    step(other, resumed)
    assert meta["iteration"] == 1 and torch.equal(other.weight, layer.weight)
    assert resumed.param_groups[0]["betas"] == (0.8, 0.99)


def test_flatten_keeps_key_types_tuples_and_every_bit_of_floats(tmp_path):
    tree = {
        0: torch.ones(1),
        "0": torch.zeros(1),
        None: (1, [2, (3.0,)], {}),
        True: {"dict": {"tensor": "tuple"}, 1.5: None},
        "floats": [0.1 + 0.2, 5e-324, -0.0, math.inf],
    }
    tensors, skeleton = flatten(tree)
    save_state(tmp_path / "s", tensors, {"tree": skeleton})
    tensors, meta = load_state(tmp_path / "s")
    back = unflatten(tensors, meta["tree"])
    assert torch.equal(back[0], tree[0]) and torch.equal(back.pop("0"), tree.pop("0"))
    back[0] = tree[0]
    assert repr(back) == repr(tree)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda path: flatten({"a": object()}), "tree.a: cannot save a object; use tensors, dicts"),
        (lambda path: flatten({(1, 2): 3}), "a dict key may be str, int, float, bool or None, not (1, 2)"),
        (
            lambda path: save_state(path, {}, {"a": {0: 1}}),
            "meta.a: the key 0 is not a string; pass the tree",
        ),
        (lambda path: save_state(path, {}, {"a": [(1,)]}), "meta.a[0]: (1,) has no exact JSON form"),
        (lambda path: load_state(path), "does not exist; there is no state to resume from"),
        (lambda path: (path.write_text("x" * 99), load_state(path)), "is not a safetensors file"),
        (lambda path: load_state(save(path.parent / "a") / "model.safetensors"), "but not a kinetok state"),
        (
            lambda path: unflatten({"tree.a": 0}, {"tensor": "tree.b"}),
            "names a tensor 'tree.b' that is absent; did",
        ),
    ],
)
def test_state_messages(tmp_path, call, message):
    with pytest.raises((CheckpointError, ValueError)) as error:
        call(tmp_path / "state")
    assert message in str(error.value)
