.PHONY: demo check test slow bench

demo:
	kinetok demo

check:
	ruff format --check . && ruff check . && pyright

test:
	pytest

slow:
	pytest -m slow

bench:
	python benchmarks/run.py
