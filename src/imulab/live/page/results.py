"""What the page shows of a record first: verdict, the few numbers to see, one figure, and what to do next."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from imulab.errors import ImulabError
from imulab.records import is_json
from imulab.report import json_for_script
from imulab.report.traces import Figure, narrow

_MOST_READ, _MOST_DRAWN = 1 << 25, 1 << 22
"""Bytes of a record that this process reads for the page, and of a figure that it sends."""
_BOLD = re.compile(r"\\u003c/?[bi]>")


def result_of(paths: list[str]) -> dict[str, Any]:
    """Return the result in the first record among the outputs of a command; an empty one where there is none."""
    from imulab.procedures.registry import load
    from imulab.procedures.views import exhibits_of

    for path in paths:
        if not path.endswith(".json") or not Path(path).is_file() or not is_json(path):
            continue
        try:
            if Path(path).stat().st_size > _MOST_READ:  # a record has some kilobytes; the report shows this one
                continue
            record = load(path)
            exhibits = exhibits_of(record)
        except (ImulabError, OSError):  # not a record, or replaced meanwhile
            continue
        figures = exhibits.figures
        figure = next((each for each in figures if "esidual" in each.title), figures[0] if figures else None)
        return {
            "record": path,
            "procedure": record.procedure,
            "state": record.verdict.state,
            "headline": exhibits.headline,
            "reasons": list(record.verdict.reasons),
            "next": list(record.verdict.next),
            "facts": exhibits.facts,
            "figure": figure and _drawn(figure),
        }
    return {}


def _drawn(figure: Figure) -> dict[str, Any] | None:
    """Return what Plotly draws, None where that is too much for a page that is shown at once.

    It makes no links of the texts, and no styles, which the page's policy forbids.
    """
    texts = {"title": figure.title, "caption": figure.message or figure.caption}
    drawn = {"data": figure.traces, "layout": figure.layout, "height": figure.height, "narrow": narrow(figure)}
    text = _BOLD.sub("", json_for_script({**texts, **drawn}))
    safe: dict[str, Any] | None = json.loads(text) if len(text) <= _MOST_DRAWN else None
    return safe
