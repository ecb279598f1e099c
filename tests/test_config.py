"""config.py: round trips, typed overrides, and a table of bad call -> message."""

import json
from dataclasses import dataclass, field
from typing import Literal

import pytest

from kinetok.config import ConfigError, at_least, below, diff, from_dict, nearest, override, pick, to_dict


@dataclass(frozen=True, kw_only=True)
class PPO:
    epochs: int = 4
    clip: float = 0.2

    def __post_init__(self):
        if self.clip <= 0:
            raise ValueError(f"clip must be positive, not {self.clip}")


@dataclass(frozen=True, kw_only=True)
class FSQ:
    kind: Literal["fsq"] = "fsq"
    levels: int = 9


@dataclass(frozen=True, kw_only=True)
class VQ:
    kind: Literal["vq"] = "vq"
    codes: int = 512


@dataclass(frozen=True, kw_only=True)
class Root:
    name: str
    residual: bool = False
    bound: Literal["tanh", "round"] = "tanh"
    future: tuple[int, ...] = (1, 2, 5)
    span: tuple[float, float] = (0.0, 1.0)
    feet: tuple[str, ...] = ()
    rate: float | None = None
    seed: int | str = 0
    weights: dict[str, float] = field(default_factory=lambda: {"pose": 0.5})
    ppo: PPO = PPO()
    prior: PPO | None = None
    quantizer: FSQ | VQ = FSQ()


ROOT = Root(name="run")


@pytest.mark.parametrize(
    "config",
    [
        ROOT,
        Root(name="", feet=("left", "right"), rate=0.1 + 0.2, prior=PPO(epochs=1), quantizer=VQ(codes=3)),
        Root(name="7", seed="x", span=(1e-300, 1e300), weights={}),
    ],
)
def test_json_round_trip(config):
    assert from_dict(Root, json.loads(json.dumps(to_dict(config)))) == config


def test_missing_keys_take_defaults_and_int_stands_for_float():
    config = from_dict(Root, {"name": "a", "rate": 3, "span": [0, 2]})
    assert config == Root(name="a", rate=3.0, span=(0.0, 2.0))
    assert type(config.rate) is float and type(config.span[0]) is float


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({}, "config: missing key 'name', which has no default in Root"),
        ([], "config: expected an object with the keys of Root, not [] (list)"),
        ({"name": 3}, "config.name: expected str, not 3 (int)"),
        ({"name": "a", "residul": True}, "unknown key 'residul'; the keys of Root are: name, residual,"),
        ({"name": "a", "residul": True}, "did you mean 'residual'?"),
        ({"name": "a", "residual": 1}, "config.residual: expected bool, not 1 (int)"),
        ({"name": "a", "ppo": {"epochs": True}}, "config.ppo.epochs: expected int, not True (bool)"),
        ({"name": "a", "ppo": {"epochs": 2.0}}, "config.ppo.epochs: expected int, not 2.0 (float)"),
        ({"name": "a", "ppo": {"clip": False}}, "config.ppo.clip: expected float, not False (bool)"),
        ({"name": "a", "ppo": {"clip": -1.0}}, "config.ppo: clip must be positive, not -1.0"),
        ({"name": "a", "ppo": None}, "config.ppo: expected an object with the keys of PPO, not None"),
        (
            {"name": "a", "bound": "tahn"},
            "config.bound: 'tahn' is not one of: 'tanh', 'round'; did you mean 'tanh'?",
        ),
        ({"name": "a", "future": [1, "2"]}, "config.future[1]: expected int, not '2' (str)"),
        ({"name": "a", "future": "12"}, "config.future: expected tuple[int, ...], not '12' (str)"),
        ({"name": "a", "span": [1.0]}, "config.span: expected 2 values, not 1: [1.0]"),
        ({"name": "a", "rate": "fast"}, "config.rate: expected float, not 'fast' (str)"),
        ({"name": "a", "seed": 0.5}, "config.seed: expected int | str, not 0.5 (float)"),
        ({"name": "a", "weights": {"pose": "x"}}, "config.weights.pose: expected float, not 'x' (str)"),
        ({"name": "a", "quantizer": {"kind": "fqs"}}, "'fqs' is not one of: fsq, vq; did you mean 'fsq'?"),
        ({"name": "a", "quantizer": {"codes": 3}}, "config.quantizer: missing key 'kind', one of: fsq, vq"),
        ({"name": "a", "quantizer": {"kind": "vq", "levels": 3}}, "config.quantizer: unknown key 'levels'"),
    ],
)
def test_from_dict_messages(data, message):
    with pytest.raises(ConfigError) as error:
        from_dict(Root, data)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("assignment", "key", "value"),
    [
        ("ppo.epochs=6", "ppo", PPO(epochs=6)),
        ("ppo.clip=1e-3", "ppo", PPO(clip=0.001)),
        ("future=(1,2,5)", "future", (1, 2, 5)),
        ("future=[7, 8]", "future", (7, 8)),
        ("future=1,2", "future", (1, 2)),
        ("future=4", "future", (4,)),
        ("future=()", "future", ()),
        ("span=0,2", "span", (0.0, 2.0)),
        ("feet=left, right", "feet", ("left", "right")),
        ("residual=true", "residual", True),
        ("residual=False", "residual", False),
        ("bound=round", "bound", "round"),
        ("rate=3", "rate", 3.0),
        ("rate=none", "rate", None),
        ("name=5", "name", "5"),
        ("name=a=b", "name", "a=b"),
        ("name='quoted'", "name", "quoted"),
        ("seed=7", "seed", 7),
        ("seed=seven", "seed", "seven"),
        ("weights.pose=1", "weights", {"pose": 1.0}),
        ('weights={"root": 2}', "weights", {"root": 2.0}),
        ("quantizer.levels=5", "quantizer", FSQ(levels=5)),
        ("quantizer.kind=vq", "quantizer", VQ()),
    ],
)
def test_override_reads_text_by_the_fields_type(assignment, key, value):
    changed = override(ROOT, [assignment])
    assert getattr(changed, key) == value and type(getattr(changed, key)) is type(value)
    assert to_dict(changed) | {key: None} == to_dict(ROOT) | {key: None}


def test_overrides_apply_in_order_and_leave_the_original():
    before = to_dict(ROOT)
    changed = override(ROOT, ["quantizer.kind=vq", "quantizer.codes=3", "ppo.epochs=1", "ppo.epochs=2"])
    assert changed.quantizer == VQ(codes=3) and changed.ppo.epochs == 2
    assert to_dict(ROOT) == before


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Of which a check concerns two fields."""

    low: int = 0
    high: int = 1
    quantizer: FSQ | VQ = FSQ()

    def __post_init__(self):
        if self.low >= self.high:
            raise ConfigError(f"low {self.low} must be below high {self.high}")


@pytest.mark.parametrize("order", [["low=5", "high=6"], ["high=6", "low=5"]])
def test_settings_are_checked_together_in_any_order(order):
    assert override(Pair(), order) == Pair(low=5, high=6)
    with pytest.raises(ConfigError, match="config: low 5 must be below high 1"):
        override(Pair(), ["low=5"])


def test_a_kind_counts_before_its_settings_and_the_same_kind_changes_nothing():
    assert override(ROOT, ["quantizer.codes=3", "quantizer.kind=vq"]).quantizer == VQ(codes=3)
    custom = override(ROOT, ["quantizer.levels=5"])
    assert override(custom, ["quantizer.kind=fsq"]) == custom
    with pytest.raises(ConfigError, match=r"config\.quantizer: unknown key 'levels'; one of: kind, codes"):
        override(ROOT, ["quantizer.levels=5", "quantizer.kind=vq"])


def test_limits_name_key_value_and_remedy():
    at_least(PPO(epochs=1), 1, {"epochs": "one is enough"})
    with pytest.raises(ConfigError, match="epochs must be at least 1, not 0; one is enough"):
        at_least(PPO(epochs=0), 1, {"epochs": "one is enough"})
    with pytest.raises(ConfigError, match=r"clip must be at least 0\.1, not nan; more"):
        at_least(PPO(clip=float("nan")), 0.1, {"epochs": "more", "clip": "more"})
    below(PPO(epochs=1), 2, {"epochs": "one is enough"})
    with pytest.raises(ConfigError, match="epochs must be below 2, not 2; one is enough"):
        below(PPO(epochs=2), 2, {"epochs": "one is enough"})


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("ppo.epochs", "cannot read 'ppo.epochs'; write key=value, for example ppo.epochs=6"),
        ("ppo.epoch=6", "config.ppo: unknown key 'epoch'; one of: epochs, clip; did you mean 'epochs'?"),
        ("ppo.epochs=six", "config.ppo.epochs: expected int, not 'six' (str)"),
        ("ppo.clip=-1", "config.ppo: clip must be positive, not -1.0"),
        ("ppo=6", "config.ppo is a PPO; assign one of its keys: ppo.epochs, ppo.clip"),
        ("prior.epochs=6", "config.prior is None, which has no key 'epochs'"),
        ("name.first=a", "config.name is 'run', which has no key 'first'"),
        ("weights.poes=1", "config.weights: unknown key 'poes'; one of: pose; did you mean 'pose'?"),
        ("residual=yes", "config.residual: expected bool, not 'yes' (str)"),
        ("quantizer.kind=vqq", "'vqq' is not one of: fsq, vq; did you mean 'vq'?"),
    ],
)
def test_override_messages(assignment, message):
    with pytest.raises(ConfigError) as error:
        override(ROOT, [assignment])
    assert message in str(error.value)


def test_to_dict_refuses_leaves_without_a_json_form():
    with pytest.raises(ConfigError, match=r"config\.name: b'a' \(bytes\) has no JSON form"):
        to_dict(Root(name=b"a"))  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="expected a dataclass instance"):
        to_dict(Root)


def test_pick_and_nearest():
    assert pick({"fsq": 1}, "fsq", "quantizer") == 1
    with pytest.raises(ConfigError) as error:
        pick({"fsq": 1, "vq": 2}, "FSK", "quantizer")
    assert str(error.value) == "unknown quantizer 'FSK'; one of: fsq, vq; did you mean 'fsq'?"
    assert nearest("zzz", ["fsq"]) == ""


def test_diff_names_each_changed_leaf():
    changed = override(ROOT, ["ppo.epochs=6", "future=1"])
    assert diff(ROOT, changed) == ["future: [1, 2, 5] -> [1]", "ppo.epochs: 4 -> 6"]
    assert diff(to_dict(ROOT), ROOT) == []
    assert diff({"a": {"b": 1}}, {"a": {}}) == ["a.b: 1 -> (absent)", "a: (absent) -> {}"]
