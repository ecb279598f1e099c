.PHONY: demo check test slow fuzz bench

demo:
	kinetok demo

check:
	ruff format --check . && ruff check . && pyright

test:
	pytest

slow:
	pytest -m slow

fuzz:
	KINETOK_FUZZ=100000 pytest -m slow -s tests/motion/formats/test_fuzz.py

bench:
	python benchmarks/run.py
