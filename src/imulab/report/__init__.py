"""Reports: exhibits and a record as one self-contained HTML file that opens from disk without a network."""

from __future__ import annotations

import json
import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from functools import cache
from hashlib import sha256
from typing import Any

from msgspec import Struct

from imulab.display import SENTENCES, Verdict
from imulab.records.calibration import Calibration
from imulab.report.parameters import with_superscripts
from imulab.report.traces import Exhibits, Figure, ReportTable, narrow

_HEADS = {"good": "Good", "look": "Look first", "bad": "Stop"}
_LINK = re.compile(r"<(?=\s*/?\s*a\b)", re.IGNORECASE)
_NUMBER = re.compile(r"[<>±+−-]?\s?\d[\d.,]*(?:e[-+]?\d+)?(?![\w.-])|nan\b")


def render(record: Calibration, exhibits: Exhibits, title: str) -> str:
    """Return the report of a record as HTML text."""
    return render_page(
        title,
        record.sensor.get("serial", "unit without serial number"),
        exhibits,
        verdict=record.verdict,
        notes=[warning for warning in record.warnings if warning not in record.verdict.reasons],
        provenance=_provenance(record),
    )


def render_page(
    title: str,
    subject: str,
    exhibits: Exhibits,
    *,
    verdict: Verdict | None = None,
    notes: Sequence[str] = (),
    provenance: Sequence[tuple[str, str]] = (),
) -> str:
    """Return exhibits as HTML text: subject, verdict, result, notes, figures and tables, provenance."""
    plots = exhibits.figures
    return str(
        _template("page.html.j2").render(
            title=title,
            subject=subject,
            verdict=verdict,
            notes=notes,
            exhibits=exhibits,
            is_figure=lambda item: isinstance(item, Figure),
            column_kinds=_column_kinds,
            draw=_draw(plots),
            plotly=_plotly(),
            provenance=provenance,
        )
    )


def _column_kinds(table: ReportTable) -> list[str]:
    """Return ``unit`` or ``text`` for the columns that hold no number; the first stands at the left anyway."""
    kinds = [""] * len(table.columns)
    for number, title in enumerate(table.columns[1:], start=1):
        cells = [row[number] for row in table.rows if row[number] not in ("", "–")]
        if title.split()[:1] == ["unit"]:
            kinds[number] = "unit"
        elif cells and not any(_NUMBER.match(cell) for cell in cells):
            kinds[number] = "text"
    return kinds


def render_plan(title: str, lead: str, attitudes: list[dict[str, Any]], predicted: list[tuple[str, str, str]]) -> str:
    """Return the printable sheet of a plan as HTML text; each attitude's `picture` is SVG made by imulab itself."""
    from markupsafe import Markup

    shown = [{**item, "picture": Markup(item["picture"])} for item in attitudes]
    return str(_template("plan.html.j2").render(title=title, lead=lead, attitudes=shown, predicted=predicted))


class Card(Struct, frozen=True):
    """A piece of work on an index page: question, answer, commands, a figure, the report, the verdict."""

    question: str
    answer: str
    commands: list[str]
    figure: Figure | None = None
    link: str = ""
    verdict: Verdict | None = None


def render_index(title: str, lead: str, cards: list[Card]) -> str:
    """Return a page that leads to several reports as HTML text."""
    return str(
        _template("index.html.j2").render(
            title=title, lead=lead, cards=cards, draw=_draw([card.figure for card in cards]), plotly=_plotly()
        )
    )


@cache
def _template(name: str) -> Any:
    from jinja2 import Environment, FunctionLoader, StrictUndefined
    from markupsafe import Markup

    def written(value: Any) -> Any:
        return with_superscripts(value) if isinstance(value, str) and not isinstance(value, Markup) else value

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, loader=FunctionLoader(_file),
        finalize=written,
    )  # fmt: skip
    environment.globals |= {
        "policy": _policy, "style": Markup(_file("style.css")), "sentences": SENTENCES, "heads": _HEADS,
    }  # fmt: skip
    return environment.get_template(name)


@cache
def _file(*name: str) -> str:
    from importlib.resources import files  # takes 2 ms to load, which a command without a report need not

    return files("imulab.report").joinpath(*name).read_text(encoding="utf-8")


def _draw(figures: Sequence[Figure | None]) -> Any:
    """Return the script that draws figures, with their data; None leaves a place empty."""
    from markupsafe import Markup

    plots = [None if f is None else {**_screen(f), "narrow": narrow(f)} for f in figures]
    return Markup("const plots = {};\n").format(json_for_script(plots)) + Markup(_file("draw.js"))


def _screen(figure: Figure) -> dict[str, Any]:
    return {"data": figure.traces, "layout": figure.layout, "height": figure.height}


def _policy(*scripts: str) -> str:
    """Return the content security policy of a page: its own scripts, by their SHA-256, and nothing from elsewhere."""
    digests = [b64encode(sha256(script.encode("utf-8")).digest()).decode("ascii") for script in scripts]
    hashes = " ".join(f"'sha256-{digest}'" for digest in digests)
    return f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'"


@cache
def _plotly() -> Any:
    from markupsafe import Markup

    return Markup(_file("vendor", "plotly-cartesian.min.js").replace("</script", "<\\/script"))


def json_for_script(value: Any) -> Any:
    """Return JSON that cannot end the script element it stands in, and whose texts Plotly makes no links of."""
    from markupsafe import Markup

    try:
        text = json.dumps(value, ensure_ascii=False, allow_nan=False)
    except ValueError:  # what is no number is not drawn
        text = json.dumps(json.loads(json.dumps(value), parse_constant=lambda _: None), ensure_ascii=False)
    text = _LINK.sub("&lt;", text)
    return Markup(text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029"))


def _provenance(record: Calibration) -> list[tuple[str, str]]:
    rows = [("created", record.created), ("software", record.software)]
    rows += [(f"source {source.file}", f"SHA-256 {source.sha256}") for source in record.sources]
    rows += [(f"sensor {key}", value) for key, value in record.sensor.items()]
    rows += [(f"model {key}", _plain(value)) for key, value in record.model.items()]
    rows += [(f"option {key}", _plain(value)) for key, value in record.options.items()]
    rows.append(("record SHA-256", str(record.to_dict()["content_sha256"])))
    return rows


def _plain(value: Any) -> str:
    if isinstance(value, Mapping):
        if {"value", "unit"} <= set(value):
            origin = f" ({value['from']})" if "from" in value else ""
            return f"{value['value']:.9g} {value['unit']}{origin}"
        return ", ".join(f"{key} {_plain(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_plain(item) for item in value if item != "") or "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.9g}"
    return "–" if value is None else str(value)
