"""Records to one blob: the tables that the C core loads at run time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from imulab.atomic_write import replacing
from imulab.device.blob import make_blob
from imulab.errors import OptionError
from imulab.exporters import ExportOptions
from imulab.procedures.unit_tables import tables_of_all
from imulab.records.calibration import Calibration


def export(records: Sequence[Calibration], folder: Path, options: ExportOptions) -> list[Path]:
    """Write ``unit.blob``.

    Raises
    ------
    RecordError
        A record lacks something, two give the same table, or a number is beyond the range of a float.
    OptionError
        The file cannot be written.
    """
    data = make_blob(records, tables_of_all(records, options.fusion))
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OptionError(f"{folder}: the folder cannot be made: {error.strerror}") from None
    target = folder / "unit.blob"
    with replacing(target) as stream:
        stream.write(data)
    return [target]
