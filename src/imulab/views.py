"""Functions that show, apply and export recordings and records, handed down from the modules above them.

A person asks a `Recording` or a `Calibration` to plot, to correct or to export; what does so knows every procedure and
lies above them. The face of the package says where it is to be had, and the methods ask `views` for it. It stands alone
because every command begins with it, and nothing else is to be imported then.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path


class AnyPlot(Protocol):
    """One figure, which shows itself in a notebook; `imulab.report.plots.Plot` says more."""

    @property
    def name(self) -> str:
        """Title of the figure."""

    def to_dict(self) -> dict[str, Any]:
        """Return the figure as Plotly's own JSON values: ``data`` and ``layout``."""

    def save(self, path: str | Path) -> None:
        """Write the figure: ``.html`` as a page that needs no network, ``.png``, ``.svg`` and ``.pdf`` as a picture."""


class AnyPlots(Protocol):
    """Several figures, by number or by words of their titles; see `imulab.report.plots.Plots`."""

    def __getitem__(self, which: int | str) -> AnyPlot:
        """Return a figure by its number, or by its title or words of it."""

    def __iter__(self) -> Iterator[AnyPlot]:
        """Yield the figures."""

    def __len__(self) -> int:
        """Return the number of figures."""

    @property
    def names(self) -> list[str]:
        """Titles of the figures."""

    def save(self, path: str | Path) -> None:
        """Write all figures as one page, ``.html``, or the only one as a picture."""


class Views(Protocol):
    """The functions of `imulab.procedures.views`, which know every procedure."""

    def load(self, path: Path) -> Any:
        """Return the record in a file."""

    def text(self, record: Any) -> str:
        """Return a record in a few lines."""

    def html(self, record: Any) -> str:
        """Return a record as HTML."""

    def plots(self, record: Any, name: str | int | None) -> AnyPlots | AnyPlot:
        """Return the figures of a record's report, or the one of this name."""

    def write_report(self, record: Any, path: str | Path) -> None:
        """Write the report of a record as one HTML file."""

    def apply_to(self, record: Any, data: Any, reading: Mapping[str, Any], **options: Any) -> Any:
        """Return data corrected by a record."""

    def export_to(self, record: Any, target: str, folder: str | Path, **options: Any) -> list[Path]:
        """Write a record in the form of another program."""

    def recording_html(self, recording: Any) -> str:
        """Return a recording as HTML."""

    def recording_plots(self, recording: Any, name: str | int | None) -> AnyPlots | AnyPlot:
        """Return a recording's channels over time, a figure for each sensor, or the one of this name."""


_LOADERS: list[Callable[[], Views]] = []


def hand_down(load: Callable[[], Views]) -> None:
    """Set the function that returns the views; it is called when something is first shown, applied or exported."""
    _LOADERS[:] = [load]


@cache
def views() -> Views:
    """Return the views that were handed down."""
    return _LOADERS[0]()
