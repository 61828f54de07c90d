"""The channels of a run's recording: its columns as rates in SI, checked, block by block."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from imulab.errors import DataError, ImulabError, UnitError
from imulab.procedures.centrifuge.cells import Samples
from imulab.procedures.centrifuge.manifest import Manifest
from imulab.recording import Array, Recording, check_finite, check_time
from imulab.units import parse_unit


class Channels:
    """Samples of a run; the names of its channels are known once the first block has come.

    Attributes
    ----------
    names
        `dtg_x`, [`dtg_y`,] `fog`.
    """

    def __init__(self, blocks: Iterable[Recording], manifest: Manifest, index: int) -> None:
        self._blocks, self._manifest, self._index = blocks, manifest, index
        self.names: tuple[str, ...] = ()

    def __iter__(self) -> Iterator[Samples]:
        """Yield the blocks of the run in SI, checked.

        Raises
        ------
        DataError
            A column is missing, a sample is not finite, time does not rise.
        UnitError
            A column in count or V without a scale factor in that unit; an angle that is none.
        ImulabError
            What the reader refuses.
        """
        place = self._manifest.place(self._index)
        file = self._manifest.runs[self._index].file
        try:
            yield from self._samples()
        except ImulabError as error:
            name, found, rest = str(error).partition(": ")
            # What does not name the run names its file alone, as it was opened: that is in `place` already.
            raise type(error)(f"{place}: {rest if found and name.endswith(file) else error}") from None

    def _samples(self) -> Iterator[Samples]:
        end = -np.inf
        for block in self._blocks:
            for name in ("time", "dtg_x", "fog"):
                if name not in block:
                    raise DataError(f"no column {name}; found {' '.join(block.columns)}")
            self.names = ("dtg_x", "dtg_y", "fog") if "dtg_y" in block else ("dtg_x", "fog")
            if not len(block):
                continue
            angle = None
            checked = [*self.names]
            if "table_angle" in block:
                if parse_unit(block.units["table_angle"]).quantity != "angle":
                    raise UnitError(f"column table_angle is in {block.units['table_angle']}; expected deg or rad")
                checked.append("table_angle")
                angle = block.si("table_angle")
            check_finite(block, checked)
            time = check_time(block)
            if not time[0] > end:
                raise DataError(
                    f"{block.place(0)}, column time: time runs backwards or stands still: expected more than "
                    f"{end:.9g} s, found {time[0]:.9g} s"
                )
            end = float(time[-1])
            yield Samples(time, np.stack([_rate(block, name, self._manifest) for name in self.names]), angle)


def _rate(block: Recording, name: str, manifest: Manifest) -> Array:
    """A column as rate, rad/s."""
    unit = parse_unit(block.units[name])
    if unit.quantity == "rate":
        return block.si(name)
    known = manifest.scale_factors.get(name)
    if known is None:
        raise UnitError(
            f"column {name} is in {unit.symbol}: expected a unit of rate, or {name} under [scale_factor] in the "
            "manifest"
        )
    if known[1] != unit.symbol:
        raise UnitError(f"column {name} is in {unit.symbol}, but its scale factor is in {known[1]} per rate")
    rate: Array = block.column(name) / known[0]
    return rate
