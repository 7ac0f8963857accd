"""The shell of a page: one self-contained HTML text that asks nothing of the network, with every text escaped."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from typing import Any

from railnav.errors import RailnavError

#: Forbids the browser every request: scripts and styles stand in the page itself, pictures are data.
CONTENT_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; font-src data:; "
    "connect-src 'none'; base-uri 'none'; form-action 'none'"
)


@dataclass(frozen=True, slots=True)
class Card:
    """A key figure: what it is, its value in words, and what to know about it."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True, slots=True)
class Table:
    """A table: the first `left` columns are words, the others figures; a click on a row with a place in `at` shows it in that figure."""

    columns: Sequence[str]
    rows: Sequence[Sequence[object]]
    left: int = 1
    caption: str = ""
    at: Sequence[tuple[str, float] | None] = ()


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of plotly.js: plain data and layout.

    Attributes
    ----------
    id : str
        Identifier in the page.
    data, layout
        As plotly.js takes them. Texts from outside go through `html.escape` first: plotly.js reads a few tags.
    moves : bool
        Whether hovering moves the train in the plan; the x axis must then be the time of `marker`.
    marker : dict, optional
        Of the plan only: time, x and y of the train, and the index of the trace that shows it; `places` may hold time, x and y by figure.
    fine : dict, optional
        Curves as measured, packed (`railnav.web.strips.stack`): shown when the figure is zoomed.
    """

    id: str
    data: Sequence[dict[str, Any]]
    layout: dict[str, Any]
    moves: bool = False
    marker: dict[str, Any] | None = None
    fine: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class Section:
    """A heading, words, and what they are about."""

    heading: str
    words: str = ""
    parts: Sequence[Figure | Table | Code | Warnings] = field(default_factory=tuple)


@dataclass(frozen=True, slots=True)
class Code:
    """Lines to type."""

    lines: Sequence[str]


@dataclass(frozen=True, slots=True)
class Warnings:
    """Things the reader must know."""

    lines: Sequence[str]


def page(
    title: str,
    *,
    subtitle: str = "",
    badge: str = "",
    lead: Sequence[str] = (),
    cards: Sequence[Card] = (),
    sections: Sequence[Section] = (),
    footer: str = "",
) -> str:
    """Compose a page.

    Parameters
    ----------
    title, subtitle, badge, footer : str
        Plain text; the badge says what kind of data this is, e.g. "Simulated data".
    lead : sequence of str
        Paragraphs that say the result in words.
    cards : sequence of Card
    sections : sequence of Section

    Returns
    -------
    str
        HTML with plotly.js inside; all text is escaped, and the page's content policy forbids every request.

    Raises
    ------
    RailnavError
        If plotly is not installed.
    """
    figures = [part for section in sections for part in section.parts if isinstance(part, Figure)]
    return "\n".join(
        [
            "<!doctype html>",
            '<html lang="en">',
            "<head>",
            '<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{escape(CONTENT_POLICY)}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(title)}</title>",
            f"<style>{_resource('page.css')}</style>",
            "</head>",
            "<body>",
            "<header>",
            f'<div class="badge">{escape(badge)}</div>' if badge else "",
            f"<h1>{escape(title)}</h1>",
            f'<p class="subtitle">{escape(subtitle)}</p>' if subtitle else "",
            *(f'<p class="lead">{escape(paragraph)}</p>' for paragraph in lead),
            _cards(cards),
            "<noscript><p>The charts need JavaScript; the figures in words do not.</p></noscript>",
            "</header>",
            "<main>",
            *(_section(section) for section in sections),
            "</main>",
            f"<footer>{escape(footer)}</footer>" if footer else "",
            f'<script type="application/json" id="figures">{_json([_figure_data(f) for f in figures])}</script>',
            f"<script>{_plotly()}</script>" if figures else "",
            f"<script>{_resource('page.js')}</script>" if figures else "",
            f"<script>{_resource('strips.js')}</script>" if any(figure.fine for figure in figures) else "",
            "</body>",
            "</html>",
            "",
        ]
    )


def _cards(cards: Sequence[Card]) -> str:
    if not cards:
        return ""
    inner = "".join(
        f'<div class="card"><dt>{escape(card.label)}</dt><dd><span class="value">{escape(card.value)}</span>'
        f'<span class="note">{escape(card.note)}</span></dd></div>'
        for card in cards
    )
    return f'<dl class="cards">{inner}</dl>'


def _section(section: Section) -> str:
    words = "".join(f"<p>{escape(paragraph)}</p>" for paragraph in section.words.split("\n\n") if paragraph)
    return (
        f"<section><h2>{escape(section.heading)}</h2>{words}{''.join(_part(part) for part in section.parts)}</section>"
    )


def _part(part: Figure | Table | Code | Warnings) -> str:
    if isinstance(part, Figure):
        height = int(part.layout.get("height", 400))
        return f'<figure><div class="plot" id="{escape(part.id)}" style="height:{height}px"></div></figure>'
    if isinstance(part, Code):
        return f"<pre>{escape(chr(10).join(part.lines))}</pre>"
    if isinstance(part, Warnings):
        items = "".join(f"<li>{escape(line)}</li>" for line in part.lines)
        return f'<ul class="warnings">{items}</ul>' if items else ""
    return _table(part)


def _table(table: Table) -> str:
    shown = [k for k in range(len(table.columns)) if any(str(row[k]) for row in table.rows)]
    mark = ['class="n"' if k >= table.left else "" for k in range(len(table.columns))]
    head = "".join(f"<th {mark[k]}>{escape(table.columns[k])}</th>" for k in shown)
    places = table.at or [None] * len(table.rows)
    rows = "".join(
        _row(place) + "".join(f"<td {mark[k]}>{escape(str(row[k]))}</td>" for k in shown) + "</tr>"
        for row, place in zip(table.rows, places, strict=True)
    )
    caption = f"<caption>{escape(table.caption)}</caption>" if table.caption else ""
    return f'<div class="scroll"><table>{caption}<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'


def _row(place: tuple[str, float] | None) -> str:
    return "<tr>" if place is None else f'<tr class="go" data-figure="{escape(place[0])}" data-x="{place[1]:.7g}">'


def _figure_data(figure: Figure) -> dict[str, Any]:
    return {
        "id": figure.id,
        "data": figure.data,
        "layout": figure.layout,
        "moves": figure.moves,
        "marker": figure.marker,
        "fine": figure.fine,
    }


def _plain(value: Any) -> Any:
    """Arrays to lists of short numbers; what is not finite becomes a gap."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.7g}") if math.isfinite(value) else None
    return value


def _json(value: Any) -> str:
    """Write JSON that no text in it can leave: `<` never stands in it."""
    text = json.dumps(_plain(value), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def _resource(name: str) -> str:
    return files("railnav.web").joinpath(name).read_text(encoding="utf-8")


def _plotly() -> str:
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise RailnavError('pages need plotly; install with: pip install "railnav[report]"') from error
    script: str = get_plotlyjs()
    return script
