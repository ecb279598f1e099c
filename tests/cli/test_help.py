"""Every command explains itself, at once, and a mistake can be looked into."""

import subprocess
import sys
from pathlib import Path

import click
import pytest

from kinetok.cli import main
from kinetok.cli.shared import VIDEOS
from kinetok.render.video import ENCODERS
from tests.cli.typed import kinetok


def leaves(group: click.Group, path: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    found = []
    for name, command in group.commands.items():
        found += leaves(command, (*path, name)) if isinstance(command, click.Group) else [(*path, name)]
    return found


def command_at(path: tuple[str, ...]) -> click.Command:
    command = main
    for name in path:
        command = command.commands[name]  # type: ignore[attr-defined]
    return command


def test_the_commands_stand_in_the_order_of_the_chain():
    result = kinetok("--help")
    assert result.exit_code == 0
    order = [result.output.index(f"\n  {name} ") for name in ("clips", "tokenize", "pretrain", "sample", "evaluate")]
    assert order == sorted(order)
    assert "kinetok tokenize fit --clips walk.txt --out runs/w" in result.output
    assert kinetok("--version").output.startswith("kinetok, version ")


@pytest.mark.parametrize("path", leaves(main), ids=" ".join)
def test_every_command_and_option_explains_itself(path):
    result = kinetok(*path, "--help")
    assert result.exit_code == 0 and "Usage: " in result.output
    command = command_at(path)
    assert command.help and len(command.help.split()) >= 6
    for parameter in command.params:
        if isinstance(parameter, click.Option):
            assert parameter.help, f"{' '.join(path)} {parameter.opts[0]} has no help"
            assert parameter.opts[0] in result.output
            shown = parameter.show_default or parameter.required or parameter.multiple or not parameter.default
            assert shown, f"{' '.join(path)} {parameter.opts[0]} does not show its default {parameter.default}"


@pytest.mark.parametrize("args", [["--help"], ["tokenize", "--help"], ["tokenize", "fit", "--help"]], ids=" ".join)
def test_help_loads_no_torch(args):
    code = (
        "import sys\nfrom kinetok.cli import main\n"
        "try:\n    main(sys.argv[1:])\nexcept SystemExit:\n    pass\n"
        "assert not {'torch', 'mujoco', 'numpy'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code, *args], check=True, capture_output=True, cwd=Path(__file__).parents[2])


def test_a_traceback_can_be_had(tmp_path, monkeypatch):
    monkeypatch.setenv("KINETOK_TRACEBACK", "1")
    with pytest.raises(ValueError, match="does not exist"):
        kinetok("clips", "info", tmp_path / "no.txt")


def test_the_videos_offered_are_those_that_can_be_written():
    assert tuple(ENCODERS) == VIDEOS
