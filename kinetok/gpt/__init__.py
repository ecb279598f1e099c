"""The next-token model over motion tokens."""

from kinetok.gpt.cache import KVCache
from kinetok.gpt.model import GPT, GPTConfig
from kinetok.gpt.sample import draw, nucleus, restrict, sample

__all__ = ["GPT", "GPTConfig", "KVCache", "draw", "nucleus", "restrict", "sample"]
