"""The code of docs/coordinates.md and docs/stores.md runs, block after block; their commands are commands."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import click
import pytest

from railnav.cli import VERBS, main

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize("page", ["coordinates.md", "stores.md"])
def test_code_runs(page):
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.S)
    assert blocks
    exec(compile("\n".join(blocks), page, "exec"), {})


@pytest.mark.parametrize("page", ["coordinates.md", "stores.md"])
def test_commands_parse(page):
    text = (DOCS / page).read_text(encoding="utf-8")
    commands = re.findall(r"^    railnav (.*)$", text, re.M) + re.findall(r"`railnav ([a-z]+ [^`]+)`", text)
    assert len(commands) > 2
    for line in commands:
        words = shlex.split(line)
        assert words[0] in VERBS, line
        command = main.get_command(click.Context(main), words[0])
        rest = words[1:]
        if isinstance(command, click.Group) and rest and rest[0] in command.commands:
            command, rest = command.commands[rest[0]], rest[1:]
        known = {option for parameter in command.params for option in parameter.opts}
        assert {word for word in rest if word.startswith("-")} <= known, line
