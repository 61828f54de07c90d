"""What every fit returns, whatever the procedure: its record, and what a person does with it next."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, overload

from imulab.arguments import checked
from imulab.records.calibration import Calibration
from imulab.report.elements import Exhibits, Figure, ReportTable
from imulab.shown import Shown

if TYPE_CHECKING:
    from typing import Unpack

    import pandas
    import polars

    from imulab.reading import Data, Reading
    from imulab.recording import Array, Recording
    from imulab.report.plots import Plot, Plots
    from imulab.views import AnyPlot, AnyPlots


class Result:
    """A fit: its ``calibration`` is the record, and every method is the record's own."""

    calibration: Calibration

    def __repr__(self) -> str:
        return f"{type(self).__name__} with a {self.calibration!r}"

    def _repr_html_(self) -> str:
        return self.calibration._repr_html_()

    @checked
    def save(self, path: str | Path) -> None:
        """Write the record; errors as for `Calibration.save`."""
        self.calibration.save(path)

    @checked
    def report(self, path: str | Path) -> None:
        """Write the report; errors as for `Calibration.report`."""
        self.calibration.report(path)

    @overload
    def plot(self, name: None = None) -> AnyPlots: ...
    @overload
    def plot(self, name: str | int) -> AnyPlot: ...
    @checked
    def plot(self, name: str | int | None = None) -> AnyPlots | AnyPlot:
        """Return the report's figures, or one of them; see `Calibration.plot`."""
        return self.calibration.plot(name)

    @overload
    def to_frame(self, library: Literal["pandas"] | None = None) -> pandas.DataFrame: ...
    @overload
    def to_frame(self, library: Literal["polars"]) -> polars.DataFrame: ...
    @checked
    def to_frame(self, library: str | None = None) -> pandas.DataFrame | polars.DataFrame:
        """Return the parameters as a data frame; see `Calibration.to_frame`."""
        return self.calibration.to_frame(library)  # type: ignore[arg-type]

    def cov(self, *names: str) -> Array:
        """Return the covariance; see `Calibration.cov`."""
        return self.calibration.cov(*names)

    @checked
    def apply(self, data: Data, *, again: bool = False, heading: bool = False, **reading: Unpack[Reading]) -> Recording:
        """Return data corrected by the record; see `Calibration.apply`."""
        return self.calibration.apply(data, again=again, heading=heading, **reading)

    @checked
    def export(self, target: str, folder: str | Path, **options: Any) -> list[Path]:
        """Write the record in the form of firmware or another program; see `Calibration.export`."""
        return self.calibration.export(target, folder, **options)


class Drawn(Shown):
    """A result that is no record, and shows itself by what a report on it shows; `subject` says what it is."""

    subject: ClassVar[str]

    def exhibits(self) -> Exhibits:
        """Return what a report on it shows."""
        raise NotImplementedError

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return the headline and the first table."""
        found = self.exhibits()
        table = next((item for item in found.items if isinstance(item, ReportTable)), None)
        return found.headline, *(([], []) if table is None else (table.columns, table.rows))

    @overload
    def plot(self, name: None = None) -> Plots: ...
    @overload
    def plot(self, name: str | int) -> Plot: ...
    @checked
    def plot(self, name: str | int | None = None) -> Plots | Plot:
        """Return the figures, which show themselves in a notebook, or the one whose title has these words.

        Raises
        ------
        OptionError
            There is no such figure; the message lists them.
        """
        from imulab.report.plots import Plots

        found = self.exhibits()
        plots = Plots([item for item in found.items if isinstance(item, Figure)], self.subject)
        return plots if name is None else plots[name]
