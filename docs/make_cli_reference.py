"""Write docs/cli.md from the commands themselves; `--check` only says whether it is up to date (exit code 1 if not).

python docs/make_cli_reference.py
"""

from __future__ import annotations

import inspect
import sys
from pathlib import Path

import click

from railnav.cli import VERBS, main

TARGET = Path(__file__).with_name("cli.md")


def reference() -> str:
    """Compose the reference of every verb, as Markdown."""
    lines = [
        "# Command reference",
        "",
        "Made by `python docs/make_cli_reference.py` from the commands themselves; do not edit.",
        "",
        _words(main),
        "",
        "Every verb takes `--help`. Progress is shown on stderr, and only on a terminal. Results go to stdout, as words and tables or,",
        "with `--json`, as one JSON object. Errors are one line on stderr. Nothing half-written is left at an output path.",
        "",
        "| verb | does |",
        "|---|---|",
        *(f"| [`{verb}`](#railnav-{verb}) | {short} |" for verb, (_, short) in VERBS.items()),
    ]
    for verb in VERBS:
        command = main.get_command(click.Context(main), verb)
        assert command is not None
        lines += [
            "",
            f"## railnav {verb}",
            "",
            f"    {_usage(verb, command)}",
            "",
            _words(command),
            "",
            *_options(command),
        ]
        if isinstance(command, click.Group):
            for name, part in command.commands.items():
                words = f"{verb} {name}"
                lines += [
                    "",
                    f"### railnav {words}",
                    "",
                    f"    {_usage(words, part)}",
                    "",
                    _words(part),
                    "",
                    *_options(part),
                ]
    return "\n".join(lines).rstrip() + "\n"


def _usage(verb: str, command: click.Command) -> str:
    arguments = [(p.metavar or f"{(p.name or '').upper()}") for p in command.params if isinstance(p, click.Argument)]
    required = [
        f"{max(p.opts, key=len)} {_value(p)}" for p in command.params if isinstance(p, click.Option) and p.required
    ]
    return " ".join(["railnav", verb, *arguments, *required, "[OPTIONS]"])


def _value(option: click.Option) -> str:
    if option.is_flag:
        return ""
    if isinstance(option.type, click.Choice):
        return "|".join(str(choice) for choice in option.type.choices)
    if isinstance(option.type, click.Path):
        return "PATH"
    return option.metavar or option.type.name.upper().replace(" RANGE", "")


def _words(command: click.Command) -> str:
    """The docstring, with click's kept lines as code."""
    blocks = []
    for block in inspect.cleandoc(command.help or "").split("\n\n"):
        kept, text = block.startswith("\b"), block.lstrip("\b\n")
        if not kept:
            blocks.append(text)
            continue
        code = [line for line in text.splitlines() if line.startswith("  ")]
        head = [line for line in text.splitlines() if not line.startswith("  ")]
        blocks.append("\n".join([*head, "", *(f"    {line.strip()}" for line in code)]).lstrip("\n"))
    return "\n\n".join(blocks)


def _options(command: click.Command) -> list[str]:
    lines = ["| option | meaning |", "|---|---|"]
    for option in command.params:
        if not isinstance(option, click.Option):
            continue
        value = _value(option).replace("|", "\\|")
        names = ", ".join(f"`{name}`" for name in sorted(option.opts, key=len))
        more = f" Default: {option.default}." if option.show_default and option.default is not None else ""
        more += " Required." if option.required else ""
        lines.append(f"| {names}{f' {value}' if value else ''} | {(option.help or '').strip()}{more} |")
    return lines


if __name__ == "__main__":
    if "--check" in sys.argv[1:]:
        if not TARGET.is_file() or TARGET.read_text(encoding="utf-8") != reference():
            sys.exit(f"docs/{TARGET.name} is not up to date: run python docs/make_cli_reference.py")
    else:
        TARGET.write_text(reference(), encoding="utf-8")
        print(f"docs/{TARGET.name} written")
