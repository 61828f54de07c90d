"""The figures of a report as objects that are drawn in notebooks and saved as pages or pictures."""

from __future__ import annotations

import gzip
import os
import signal
import sys
from base64 import b64encode
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib.resources import as_file, files
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, overload
from uuid import uuid4

from imulab.errors import OptionError, file_name, install, listed, quoted
from imulab.files import replacing, write_text
from imulab.report import json_for_script, render_page
from imulab.report.traces import INK, Exhibits, Figure

if TYPE_CHECKING:
    import subprocess

PICTURES = ("png", "svg", "pdf")
_WIDTH = 900  # pixels
_LIBRARY = ("vendor", "plotly-cartesian.min.js")
_BASE = {
    "font": {"family": 'system-ui, "Segoe UI", "DejaVu Sans", sans-serif', "size": 13, "color": INK},
    "margin": {"l": 70, "r": 20, "t": 20, "b": 55},
    "hovermode": "closest",
    "paper_bgcolor": "#ffffff",
    "plot_bgcolor": "#ffffff",
}
_TITLE_HEIGHT = 40  # pixels
_PATIENCE = 120.0  # s, until a Chromium that has not drawn a picture is ended
_TITLE = {"x": 0, "xanchor": "left", "yref": "container", "y": 1, "yanchor": "top", "pad": {"l": 10, "t": 14}}


@dataclass(frozen=True, repr=False)
class Plot:
    """One figure of a report: shows itself as the last line of a notebook's cell.

    Attributes
    ----------
    figure
        The figure.
    subject
        Its subject, for the page that it is saved as.

    Examples
    --------
    >>> import imulab as il
    >>> record = il.fit_tumble(il.find_attitudes(il.simulate_tumble(gravity=9.81)), order=1, gravity=9.81).calibration
    >>> record.plot("residual").save("residuals.html")
    """

    figure: Figure
    subject: str = ""

    def __repr__(self) -> str:
        return f"Plot({self.name!r}: shows itself in a notebook; .save('x.html') writes a page)"

    @property
    def name(self) -> str:
        """Title of the figure."""
        return self.figure.title

    def to_dict(self) -> dict[str, Any]:
        """Return the figure as Plotly's own JSON values: ``data`` and ``layout``."""
        drawn = _untitled(self.figure)
        margin = drawn["layout"]["margin"]
        above = max(margin["t"], _legend_height(self.figure)) + _TITLE_HEIGHT
        height = self.figure.height + above - margin["t"]
        title = {"text": escape(self.name, quote=False), **_TITLE}
        layout = {**drawn["layout"], "title": title, "margin": {**margin, "t": above}, "height": height}
        return {**drawn, "layout": layout}

    def save(self, path: str | Path) -> None:
        """Write the figure: ``.html`` as a page that needs no network, ``.png``, ``.svg`` and ``.pdf`` as a picture.

        Raises
        ------
        OptionError
            Another ending, the file cannot be written, or what draws pictures is not installed.
        """
        kind = _kind(path)
        if kind == "html":
            _write_page(path, self.subject or self.name, [self])
            return
        picture = _picture(self, kind, path)
        with replacing(path) as stream:
            stream.write(picture)

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, Any]:
        """Return the figure for notebooks: JSON for those that know Plotly, HTML for the others."""
        return {
            "application/vnd.plotly.v1+json": {**self.to_dict(), "config": {"displaylogo": False}},
            "text/html": _html(self),
            "text/plain": repr(self),
        }


class Plots(Sequence[Plot]):
    """The figures of a report, by number or name: shows all of them in a notebook."""

    def __init__(self, figures: Iterable[Figure], subject: str) -> None:
        self.subject = subject
        self._plots = tuple(Plot(figure, subject) for figure in figures)

    @overload
    def __getitem__(self, which: int | str) -> Plot: ...
    @overload
    def __getitem__(self, which: slice) -> tuple[Plot, ...]: ...
    def __getitem__(self, which: int | str | slice) -> Plot | tuple[Plot, ...]:
        """Return a figure by its number, or by its title or words of it."""
        if not isinstance(which, str):
            try:
                return self._plots[which]
            except (IndexError, TypeError):
                expected = f"a number from 0 to {len(self) - 1}, or one of {listed(map(repr, self.names), which)}"
                raise OptionError(f"plot {quoted(which)}: expected {expected}") from None
        asked = which.lower()
        matching = [plot for plot in self._plots if all(word in plot.name.lower() for word in asked.split())]
        first = [plot for plot in matching if plot.name.lower().startswith(asked)]
        if len(first or matching) == 1:
            return (first or matching)[0]
        names = [repr(plot.name) for plot in matching or self]
        problem = f"{len(matching)} figures of that name" if matching else "no such figure"
        raise OptionError(f"plot {which!r}: {problem}; expected one of {listed(names, which)}")

    def __iter__(self) -> Iterator[Plot]:
        return iter(self._plots)

    def __len__(self) -> int:
        return len(self._plots)

    @property
    def names(self) -> list[str]:
        """Titles of the figures."""
        return [plot.name for plot in self]

    def __repr__(self) -> str:
        shown = [f"  {number}  {plot.name}" for number, plot in enumerate(self._plots[:9])]
        more = [f"  ... and {len(self) - 9} more"] if len(self) > 9 else []
        return "\n".join([f"{len(self)} figures of {self.subject}", *shown, *more])

    def save(self, path: str | Path) -> None:
        """Write all figures as one page, ``.html``, or the only one as a picture; errors as for `Plot.save`."""
        if _kind(path) != "html" and len(self) == 1:
            return self[0].save(path)
        if _kind(path) != "html":
            raise OptionError(
                f"{path}: a picture holds one figure: expected one of them, as in plots[0].save({str(path)!r})"
            )
        return _write_page(path, self.subject, self._plots)

    def _ipython_display_(self) -> None:
        from IPython.display import display

        for plot in self._plots:
            display(plot)


def _kind(path: str | Path) -> str:
    """Return the ending of a name that a figure can be saved under."""
    kind = Path(file_name(path)).suffix.lower().removeprefix(".")
    if kind not in ("html", *PICTURES):
        raise OptionError(f"{path}: expected a name that ends in .html, .png, .svg or .pdf")
    return kind


def _write_page(path: str | Path, subject: str, plots: Sequence[Plot]) -> None:
    write_text(path, render_page("imulab", subject, Exhibits("", [], [plot.figure for plot in plots])))


def _picture(plot: Plot, kind: str, path: str | Path) -> bytes:
    """Return a figure as a picture, drawn by the machine's own Chromium."""
    import asyncio
    from concurrent.futures import ThreadPoolExecutor

    try:
        import kaleido
        from kaleido.errors import ChromeNotFoundError
    except ImportError:
        needed = f"kaleido: {install('plots')}"
        raise OptionError(f"{path}: a picture needs {needed}; .html needs nothing") from None
    figure = plot.to_dict()
    height, scale = figure["layout"]["height"], 2 if kind == "png" else 1
    options = {"format": kind, "width": _WIDTH, "height": height, "scale": scale}
    with as_file(files("imulab.report").joinpath(*_LIBRARY)) as library:
        try:
            browser = kaleido.Kaleido(plotlyjs=library.as_uri(), mathjax=False)
            with ThreadPoolExecutor(1) as pool:  # a notebook runs an event loop in this thread
                drawn = pool.submit(asyncio.run, _drawn(browser, figure, options)).result()
        except ChromeNotFoundError:
            needed = "Chromium or Chrome on this machine"
            raise OptionError(f"{path}: a picture needs {needed}; .html needs nothing") from None
        except Exception as error:  # whatever goes wrong in another program
            raise OptionError(f"{path}: Chromium did not draw the picture: {error}") from None
    return drawn


async def _drawn(browser: Any, figure: dict[str, Any], options: dict[str, Any]) -> bytes:
    """Return what a Chromium draws; kaleido waits for ever for one that does not answer, so it is ended here."""
    import asyncio

    begin = perf_counter()
    end = asyncio.get_running_loop().call_later(_PATIENCE, lambda: _end(browser.subprocess))
    try:
        async with browser:
            return bytes(await browser.calc_fig(figure, opts=options))
    except Exception as error:
        if perf_counter() - begin < _PATIENCE:
            raise
        raise TimeoutError(f"no answer within {_PATIENCE:g} s") from error
    finally:
        end.cancel()


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process and those that it started."""
    if hasattr(os, "killpg"):
        os.killpg(process.pid, signal.SIGKILL)  # kaleido starts a session for it
    else:
        process.kill()


def _untitled(figure: Figure) -> dict[str, Any]:
    """Return a figure without its title, which is text of the page."""
    margin = {**_BASE["margin"], **figure.layout.get("margin", {})}  # type: ignore[dict-item]
    return {"data": figure.traces, "layout": {**_BASE, **figure.layout, "margin": margin, "height": figure.height}}


def _legend_height(figure: Figure) -> int:
    """Return the height of a legend above the plot, pixels: Plotly makes room for it, but draws it over a title."""
    legend = figure.layout.get("legend", {})
    names = [trace["name"] for trace in figure.traces if "name" in trace and trace.get("showlegend", True)]
    if legend.get("orientation") != "h" or len(names) < 2:
        return 0
    in_a_row = max(1, int(0.85 * _WIDTH / max(8 * len(name) + 45 for name in names)))
    lift = (legend.get("y", 1.0) - 1) * figure.height
    return int(lift) + 20 * -(-len(names) // in_a_row) + 8


def _html(plot: Plot) -> str:
    """Return a figure as HTML that draws itself without a network."""
    place, figure = f"imulab-{uuid4().hex[:12]}", plot.figure
    paragraphs = "".join(f"<p>{escape(text)}</p>" for text in (figure.message, figure.caption) if text)
    packed = f'"{_packed()}"' if _FIRST.carries() else "null"
    script = files("imulab.report").joinpath("notebook.js").read_text(encoding="utf-8")
    return (
        f'<div style="background: #fff; color: {INK}; font-family: system-ui, sans-serif; max-width: 1000px; '
        f'padding: 4px 10px"><div style="font-size: 17px">{escape(plot.name)}</div>'
        f'<div id="{place}" style="height: {figure.height}px"></div>{paragraphs}</div>\n'
        f'<script>{script}("{place}", {json_for_script(_untitled(figure))}, {packed})</script>'
    )


@cache
def _packed() -> str:
    """Return Plotly's library, compressed to a third of its size."""
    text = files("imulab.report").joinpath(*_LIBRARY).read_bytes()
    return b64encode(gzip.compress(text, 9, mtime=0)).decode("ascii")


class _First:
    """The output of a notebook that includes the library: that of the first cell with a figure, each time it runs.

    Where every output is a page of its own, all of them include it.
    """

    def __init__(self) -> None:
        self.cell: Any = None
        self.run: Any = None

    def carries(self) -> bool:
        """Return whether the output that is being made includes it."""
        if "google.colab" in sys.modules:
            return True
        cell, run = _where()
        if self.run is None or (cell is not None and cell == self.cell and run != self.run):
            self.cell, self.run = cell, run
            return True
        return cell is None and run is None


_FIRST = _First()


def _where() -> tuple[Any, Any]:
    """Return the notebook's name of the running cell, and the number of the run; None outside of a notebook."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    if shell is None:
        return None, None
    try:
        parent = shell.kernel.get_parent()
    except AttributeError:
        return None, shell.execution_count
    return parent.get("metadata", {}).get("cellId"), shell.execution_count
