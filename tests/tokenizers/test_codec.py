import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from kinetok.checkpoint import CheckpointError, save_state
from kinetok.config import ConfigError, override
from kinetok.rl.rollout import torch_threads
from kinetok.tokenizers.codec import TokenStream, decode_tokens, encode_clip
from kinetok.tokenizers.fit import new_tokenizer
from kinetok.tokenizers.tokenizer import MotionTokenizer


@pytest.fixture(scope="module")
def tokenizer(small, standing, tmp_path_factory) -> MotionTokenizer:
    """Untrained but saved: it holds about the clips' mean pose, stays up for a second, and its codes change."""
    path = tmp_path_factory.mktemp("artifact")
    fresh = new_tokenizer(small.tokenizer, standing, 0)
    torch.nn.init.normal_(fresh.decoder[-1].weight, std=0.1, generator=torch.Generator().manual_seed(1))
    torch.nn.init.normal_(fresh.encoder[-1].weight, std=2.0, generator=torch.Generator().manual_seed(2))
    fresh.save_pretrained(path, "")
    return MotionTokenizer.from_pretrained(path)


@pytest.fixture(scope="module")
def stream(tokenizer, wave) -> TokenStream:
    return encode_clip(tokenizer, wave("wave"))


def test_the_stream_says_what_it_is(stream, tokenizer):
    steps = len(stream.tokens)
    assert stream.tokens.shape == (steps, 2) and stream.tokens.dtype == torch.int64 and 20 <= steps <= 30
    assert stream.simulated.shape == (steps + 1, len(stream.qpos))
    assert (stream.name, stream.fps, stream.tokenizer) == ("wave", 30.0, tokenizer.hash)
    assert stream.layout == tokenizer.layout and len(torch.unique(stream.tokens)) > 1
    assert np.array_equal(stream.simulated[0], stream.qpos)


def test_decoding_repeats_the_simulation_exactly(stream, tokenizer):
    assert np.array_equal(decode_tokens(tokenizer, stream), stream.simulated)


def test_a_prefix_decodes_to_a_prefix(stream, tokenizer):
    poses = decode_tokens(tokenizer, replace(stream, tokens=stream.tokens[:7]))
    assert np.array_equal(poses, stream.simulated[:8])


def test_other_tokens_move_otherwise(stream, tokenizer):
    changed = stream.tokens.clone()
    changed[5] = (changed[5] + 60) % stream.layout.vocabulary
    poses = decode_tokens(tokenizer, replace(stream, tokens=changed))
    assert np.array_equal(poses[:6], stream.simulated[:6]) and not np.array_equal(poses[6], stream.simulated[6])


@pytest.mark.parametrize("threads", [1, 2])
def test_threads_change_nothing(stream, tokenizer, wave, threads):
    with torch_threads(threads):
        again = encode_clip(tokenizer, wave("wave"))
        assert torch.equal(again.tokens, stream.tokens) and np.array_equal(again.simulated, stream.simulated)
        assert np.array_equal(decode_tokens(tokenizer, again), stream.simulated)


def test_seconds_cut_a_clip_and_lengthen_a_loop(tokenizer, wave):
    assert len(encode_clip(tokenizer, wave("wave"), seconds=0.5).tokens) == 15
    loop = encode_clip(tokenizer, wave("loop", 0.2, loop=True), seconds=0.5)
    assert len(loop.tokens) == 15
    assert np.array_equal(decode_tokens(tokenizer, loop), loop.simulated)
    assert len(encode_clip(tokenizer, wave("short", 0.2), seconds=9.0).tokens) == 6


def test_a_lost_track_ends_the_stream(tokenizer, wave):
    flight = wave("flight")
    flight.qpos[5:, 2] += 2.0
    lost = encode_clip(tokenizer, flight)
    assert len(lost.tokens) == 5 and lost.lost and not encode_clip(tokenizer, wave("wave")).lost


def test_file_round_trip(stream, tokenizer, tmp_path):
    path = tmp_path / "walk.safetensors"
    stream.save(path)
    again = TokenStream.load(path)
    assert torch.equal(again.tokens, stream.tokens) and again.layout == stream.layout
    for name in ("qpos", "qvel", "simulated"):
        assert np.array_equal(getattr(again, name), getattr(stream, name))
    assert (again.fps, again.name, again.tokenizer) == (stream.fps, stream.name, stream.tokenizer)
    assert np.array_equal(decode_tokens(tokenizer, again), stream.simulated)
    assert [file.name for file in tmp_path.iterdir()] == ["walk.safetensors"]


def other(small, standing, *settings) -> MotionTokenizer:
    return new_tokenizer(override(small, settings).tokenizer, standing, 0)


def teacher(small, standing) -> MotionTokenizer:
    return new_tokenizer(small.teacher_tokenizer, standing, 0)


def foreign(path, case):
    if case == "state":
        save_state(path, {"x": torch.zeros(1)}, {"kind": "other"})
    elif case == "safetensors":
        save_file({"x": torch.zeros(1)}, path)
    elif case == "text":
        path.write_text("tokens")
    return TokenStream.load(path)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (
            lambda t, s, c, small, table, path: decode_tokens(other(small, table, "tokenizer.scalars=2"), s),
            ConfigError,
            "the tokens have TokenLayout(groups=2, scalars=3, levels=5), the tokenizer has TokenLayout(groups=3",
        ),
        (
            lambda t, s, c, small, table, path: decode_tokens(other(small, table), s),
            ConfigError,
            "this is (unsaved); use the tokenizer that wrote them",
        ),
        (
            lambda t, s, c, small, table, path: encode_clip(other(small, table, "tokenizer.character=other"), c),
            ConfigError,
            "clip 'wave' is of 'humanoid', the tokenizer of 'other'",
        ),
        (
            lambda t, s, c, small, table, path: encode_clip(teacher(small, table), c),
            ConfigError,
            "a continuous tokenizer has no tokens",
        ),
        (
            lambda t, s, c, small, table, path: encode_clip(t, c, seconds=0.0),
            ValueError,
            "0 seconds of clip 'wave' hold no control step of 1/30 s",
        ),
        (
            lambda t, s, c, small, table, path: decode_tokens(t, replace(s, tokens=s.tokens + 125)),
            ValueError,
            "tokens must lie in 0..124",
        ),
        (lambda t, s, c, small, table, path: foreign(path, "state"), CheckpointError, "holds no tokens; write one"),
        (lambda t, s, c, small, table, path: foreign(path, "safetensors"), CheckpointError, "not a kinetok state"),
        (lambda t, s, c, small, table, path: foreign(path, "text"), CheckpointError, "is not a safetensors file"),
        (lambda t, s, c, small, table, path: foreign(path, "none"), CheckpointError, "does not exist"),
    ],
)
def test_messages(call, error, message, tokenizer, stream, wave, small, standing, tmp_path):
    with pytest.raises(error, match=re.escape(message)):
        call(tokenizer, stream, wave("wave"), small, standing, tmp_path / "x.safetensors")
