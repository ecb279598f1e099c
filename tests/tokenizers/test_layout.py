import json

import pytest
import torch

from kinetok.config import ConfigError, from_dict, to_dict
from kinetok.tokenizers import TokenLayout


def test_numbers_of_the_paper():
    layout = TokenLayout.grouped(dim=40, levels=9, scalars=5)
    assert (layout.tokens_per_step, layout.vocabulary, layout.dim) == (8, 59049, 40)


def test_by_hand_first_scalar_is_most_significant():
    layout = TokenLayout.grouped(dim=6, levels=9, scalars=3)
    # 1 * 81 + 2 * 9 + 3 = 102;  8 * 81 + 0 * 9 + 7 = 655
    tokens = layout.to_tokens(torch.tensor([[1, 2, 3, 8, 0, 7]]))
    assert tokens.tolist() == [[102, 655]] and tokens.dtype == torch.int64


@pytest.mark.parametrize(("levels", "scalars"), [(2, 1), (2, 5), (3, 3), (4, 2), (9, 3)])
def test_every_token_round_trips(levels, scalars):
    layout = TokenLayout(groups=2, scalars=scalars, levels=levels)
    ids = torch.arange(layout.vocabulary)
    tokens = torch.stack([ids, ids.flip(0)], dim=-1)
    codes = layout.to_codes(tokens)
    assert codes.shape == (layout.vocabulary, 2 * scalars)
    assert codes.min() >= 0 and codes.max() == levels - 1
    assert torch.equal(layout.to_tokens(codes), tokens)
    assert len(codes[:, :scalars].unique(dim=0)) == layout.vocabulary


def test_codes_round_trip_with_leading_dimensions():
    layout = TokenLayout.grouped(dim=24, levels=9, scalars=3)
    codes = torch.randint(9, (4, 5, 24), generator=torch.Generator().manual_seed(0))
    tokens = layout.to_tokens(codes)
    assert tokens.shape == (4, 5, 8)
    assert torch.equal(layout.to_codes(tokens), codes)
    assert layout.to_codes(tokens[:0]).shape == (0, 5, 24)


def test_one_code_per_token_is_the_identity():
    layout = TokenLayout(groups=8, scalars=1, levels=1024)
    codes = torch.arange(1024).view(128, 8)
    assert torch.equal(layout.to_tokens(codes), codes)


def test_json_round_trip():
    layout = TokenLayout.grouped(dim=40, levels=9, scalars=5)
    assert from_dict(TokenLayout, json.loads(json.dumps(to_dict(layout)))) == layout


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (
            lambda: TokenLayout.grouped(dim=24, levels=9, scalars=5),
            ValueError,
            r"one of \[1, 2, 3, 4, 6, 8, 12, 24\]",
        ),
        (lambda: TokenLayout(groups=1, scalars=1, levels=1), ValueError, "levels >= 2, not 1"),
        (lambda: TokenLayout(groups=1, scalars=20, levels=9), ValueError, "more than int64 holds"),
        (lambda: layout3().to_tokens(torch.zeros(2, 5).long()), ValueError, r"shape \(2, 5\).*must be 6"),
        (
            lambda: layout3().to_tokens(torch.full((1, 6), 3)),
            ValueError,
            r"codes must lie in 0\.\.2; found 3",
        ),
        (lambda: layout3().to_tokens(torch.full((1, 6), -1)), ValueError, "found -1"),
        (lambda: layout3().to_tokens(torch.zeros(1, 6)), ValueError, "must be integers"),
        (
            lambda: layout3().to_codes(torch.tensor([[0, 27]])),
            ValueError,
            r"tokens must lie in 0\.\.26; found 27",
        ),
        (
            lambda: from_dict(TokenLayout, {"groups": 1, "scalars": 1, "level": 3}),
            ConfigError,
            "did you mean 'levels'",
        ),
    ],
)
def test_messages(call, error, message):
    with pytest.raises(error, match=message):
        call()


def layout3() -> TokenLayout:
    return TokenLayout.grouped(dim=6, levels=3, scalars=3)
