"""`python -m kinetok.cli`, where the command itself is not on the path."""

from kinetok.cli import main

main()
