"""What is told of a tokenizer: its model card, and a table of how well it follows each clip."""

from collections.abc import Mapping, Sequence

import numpy as np
from rich.table import Table

from kinetok.config import to_dict
from kinetok.tokenizers.tokenizer import MotionTokenizer
from kinetok.tokenizers.track import TrackingScore


def clip_table(names: Sequence[str], found: Mapping[str, np.ndarray]) -> Table:
    """How well each clip is followed: success and MPJPE of whoever did, the first one's hardest clips first.

    found: who -> (K, 2), share of successes and millimetres; NaN where that is not known.
    """
    first = next(iter(found.values()))
    table = Table("clip")
    for who in found:
        table.add_column(f"{who}: success", justify="right")
        table.add_column("MPJPE mm", justify="right")
    for k in sorted(range(len(names)), key=lambda k: (first[k, 0], -first[k, 1])):
        cells = [
            text for numbers in found.values() for text in (f"{100 * numbers[k, 0]:.0f} %", f"{numbers[k, 1]:.0f}")
        ]
        table.add_row(names[k], *("-" if text.startswith("nan") else text for text in cells))
    return table


def tokenizer_card(
    tokenizer: MotionTokenizer,
    names: Sequence[str],
    story: str,
    seed: int,
    score: TrackingScore,
    push: float = 0.0,
) -> str:
    """The model card: use, training, inputs and outputs, results and limits."""
    config = tokenizer.config
    kind = config.quantizer.kind
    rows = "\n".join(
        f"| {name} | {100 * s:.0f} % | {100 * m:.0f} % | {e:.0f} |"
        for name, s, m, e in zip(score.names, score.success, score.success_mean_error, score.mpjpe_mm, strict=True)
    )
    pushed = f", pushed by {push:g} m/s every two seconds" if push else ""
    total = (
        f"| all | {100 * score.success.mean():.1f} % | {100 * score.success_mean_error.mean():.1f} % "
        f"| {score.mpjpe_mm.mean():.1f} |"
    )
    tokens = (
        ""
        if kind == "continuous"
        else (
            f"{tokenizer.layout.tokens_per_step} tokens per control step from a vocabulary of "
            f"{tokenizer.layout.vocabulary}; "
        )
    )
    return f"""# {kind} motion tokenizer for `{config.character}`

Turns a reference motion into codes and codes into joint torques, in physics at {config.scene.control_hz} Hz.

    from kinetok.tokenizers.tokenizer import MotionTokenizer
    tokenizer = MotionTokenizer.from_pretrained("PATH")

- Encoder input: {", ".join(config.encoder_inputs)} with future frames {list(config.future)}; decoder input:
  {", ".join(config.decoder_inputs) or "nothing"} and the code. Output: {tokenizer.actions} PD targets in radians.
- {tokens}quantizer `{to_dict(config.quantizer)}`.
- Stages: {story}. Seed {seed}. Clips: {", ".join(names)}.

## Tracking, {score.episodes} episodes a clip, 20 s or to the clip's end, started with 0.01 rad of noise{pushed}

Success: largest body error of the episode below 0.5 m; mean form: mean body error below 0.5 m.

| clip | success | success (mean form) | MPJPE mm |
|---|---|---|---|
{rows}
{total}

Limits: flat floor, no self-collision, the clips above. Licence: Apache-2.0.
"""
