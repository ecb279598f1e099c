"""Motion to codes and back. The table of quantizers is keyed by the `kind` of a config."""

from dataclasses import fields

from kinetok.config import pick
from kinetok.tokenizers.fsq import FSQ, FSQConfig
from kinetok.tokenizers.layout import TokenLayout
from kinetok.tokenizers.quantizer import Continuous, ContinuousConfig, Quantized, Quantizer

QUANTIZERS = {
    "continuous": (ContinuousConfig, Continuous),
    "fsq": (FSQConfig, FSQ),
}

QuantizerConfig = ContinuousConfig | FSQConfig


def build_quantizer(config: QuantizerConfig) -> Quantizer:
    """The quantizer that `config` describes, picked by `config.kind`."""
    _, quantizer = pick(QUANTIZERS, config.kind, "quantizer")
    return quantizer(**{field.name: getattr(config, field.name) for field in fields(config) if field.name != "kind"})


__all__ = [
    "FSQ",
    "QUANTIZERS",
    "Continuous",
    "ContinuousConfig",
    "FSQConfig",
    "Quantized",
    "Quantizer",
    "QuantizerConfig",
    "TokenLayout",
    "build_quantizer",
]
