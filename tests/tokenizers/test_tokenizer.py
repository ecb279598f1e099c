import re
from dataclasses import replace

import pytest
import torch

from kinetok.checkpoint import CheckpointError, save_artifact
from kinetok.config import ConfigError
from kinetok.tokenizers.fit import new_tokenizer, sizes_of
from kinetok.tokenizers.fsq import FSQConfig
from kinetok.tokenizers.tokenizer import MotionTokenizer, TokenizerConfig


@pytest.fixture
def cut(small, standing) -> dict[str, slice]:
    """Where each part of an observation lies."""
    edge, cut = 0, {}
    for part, size in sizes_of(standing, small.tokenizer.future).items():
        cut[part] = slice(edge, edge + size)
        edge += size
    return cut


@pytest.fixture
def obs(student, cut) -> torch.Tensor:
    """Random observations, to which the tokenizer's normaliser is not yet used."""
    generator = torch.Generator().manual_seed(1)
    seen = 0.3 + 2 * torch.randn(200, cut["target"].stop, generator=generator)
    student.observe(seen[:100])
    return seen[100:]


def gradients(out: torch.Tensor, obs: torch.Tensor, cut: dict[str, slice]) -> dict[str, float]:
    """Largest gradient of any output, mixed at random, with respect to each part of the observation."""
    mix = torch.randn(out.shape, generator=torch.Generator().manual_seed(2))
    (gradient,) = torch.autograd.grad((out * mix).sum(), obs)
    return {part: float(gradient[:, where].abs().max()) for part, where in cut.items()}


def test_the_action_sees_state_and_window_only(student, obs, cut):
    obs.requires_grad_()
    slopes = gradients(student.act(obs)[0], obs, cut)
    assert slopes["error"] == slopes["target"] == 0
    assert slopes["state"] > 0 and slopes["window"] > 0


def test_the_code_sees_the_window_only(student, obs, cut):
    obs.requires_grad_()
    slopes = gradients(student.quantize(obs).values, obs, cut)
    assert slopes["state"] == slopes["error"] == slopes["target"] == 0
    assert slopes["window"] > 0


def test_given_its_code_the_action_hears_no_more_of_the_reference(student, obs, cut):
    other = obs.clone()
    other[:, cut["window"].start :] = 0
    with torch.no_grad():
        assert not torch.equal(student.act(other)[0], student.act(obs)[0])
    codes = student.encode(obs)
    assert torch.equal(student.decode(codes, other[:, cut["state"]]), student.decode(codes, obs[:, cut["state"]]))


def test_a_teacher_acts_around_the_reference(small, standing, cut):
    teacher = new_tokenizer(replace(small.teacher_tokenizer, future=small.tokenizer.future), standing, 0)
    obs = torch.randn(5, cut["target"].stop, requires_grad=True)
    (gradient,) = torch.autograd.grad(teacher.act(obs)[0].sum(), obs)
    assert torch.equal(gradient[:, cut["target"]], torch.ones(5, teacher.actions))
    assert gradient[:, cut["state"]].abs().max() == 0 < gradient[:, cut["error"]].abs().max()


@pytest.mark.parametrize("levels", [5, 4])
def test_decode_of_encode_is_the_action(small, standing, cut, levels):
    config = replace(small.tokenizer, quantizer=FSQConfig(dim=6, levels=levels))
    tokenizer = new_tokenizer(config, standing, 0)
    obs = 3 * torch.randn(50, cut["target"].stop, generator=torch.Generator().manual_seed(3))
    tokenizer.observe(obs)
    with torch.no_grad():
        action = tokenizer.act(obs)[0]
    assert torch.equal(tokenizer.decode(tokenizer.encode(obs), obs[:, cut["state"]]), action)


def test_tokens_and_codes_round_trip(student, obs):
    codes, layout = student.encode(obs), student.layout
    tokens = layout.to_tokens(codes)
    assert tokens.shape == (len(obs), 2) and layout.vocabulary == 5**3
    assert torch.equal(layout.to_codes(tokens), codes)


def test_saved_and_loaded_it_is_the_same(student, obs, tmp_path):
    student.save_pretrained(tmp_path / "t", "# card", {"teacher/wave": "abc"})
    loaded = MotionTokenizer.from_pretrained(tmp_path / "t")
    assert loaded.config == student.config and loaded.sizes == student.sizes
    tensors = student.state_dict()
    assert loaded.state_dict().keys() == tensors.keys()
    assert all(torch.equal(value, tensors[name]) for name, value in loaded.state_dict().items())
    assert not loaded.training and loaded.hash and not student.hash
    with torch.no_grad():
        assert torch.equal(loaded.act(obs)[0], student.act(obs)[0])


def test_actions_start_at_the_clips_mean_pose(student, standing):
    with torch.no_grad():
        action = student.act(torch.zeros(1, sum(student.sizes.values())))[0]
    spread = torch.from_numpy(standing.target.std(0)).clamp_min(0.1)
    assert ((action - torch.from_numpy(standing.target.mean(0))).abs() < 0.2 * spread).all()


def other_kind(tmp_path, student):
    save_artifact(tmp_path / "g", kind="gpt", config={}, tensors={"x": torch.zeros(1)}, card="")
    return MotionTokenizer.from_pretrained(tmp_path / "g")


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (
            lambda **_: TokenizerConfig(residual=True),
            ConfigError,
            "a 'fsq' tokenizer's decoder sees the state and the code only; residual actions",
        ),
        (
            lambda **_: TokenizerConfig(decoder_inputs=("state", "window")),
            ConfigError,
            "decoder inputs other than 'state'",
        ),
        (
            lambda **_: TokenizerConfig(encoder_inputs=("windows",)),
            ConfigError,
            "unknown observation part 'windows'; parts: state, window, error",
        ),
        (lambda continuous, **_: continuous.layout, ConfigError, "a continuous tokenizer has no tokens; fit one"),
        (lambda continuous, **_: continuous.encode(torch.zeros(1, 2000)[:, : continuous.width]), ValueError, "no tok"),
        (lambda tmp_path, student, **_: other_kind(tmp_path, student), CheckpointError, "a 'tokenizer' was asked for"),
        (
            lambda tmp_path, **_: MotionTokenizer.from_pretrained(tmp_path / "none"),
            CheckpointError,
            "there is no directory",
        ),
    ],
)
def test_messages(call, error, message, small, standing, student, tmp_path):
    continuous = new_tokenizer(small.teacher_tokenizer, standing, 0)
    continuous.width = sum(continuous.sizes.values())
    with pytest.raises(error, match=re.escape(message)):
        call(continuous=continuous, student=student, tmp_path=tmp_path)
