"""The history: every calibration that a line has made, in SQLite or PostgreSQL, so that changes can be shown."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from imulab.errors import OptionError, install
from imulab.fleet.engine import Summary
from imulab.fleet.manifest import masked, without_secrets
from imulab.records.calibration import Parameter

_SERIALS_AT_ONCE = 500  # serials in one query: SQLite takes at least 999 variables


@dataclass(frozen=True)
class Past:
    """One calibration of the history; `sources` is a hash over the hashes of its files."""

    serial: str
    procedure: str
    when: str
    created: str
    content_sha256: str
    sources: str
    parameters: Mapping[str, Parameter]
    freedom: float | None


def sources_of(summary: Summary) -> str:
    """Return one hash for the files that a record was made from."""
    return hashlib.sha256("\n".join(sorted(summary.inputs)).encode()).hexdigest()


class History:
    """An open history."""

    def __init__(self, engine: Any, name: str, url: str) -> None:
        import sqlalchemy as sa

        self._engine = engine
        self._name, self._url = name, url
        tables = sa.MetaData()
        self._calibrations = sa.Table(
            "imulab_calibrations",
            tables,
            sa.Column("id", sa.Integer, primary_key=True, autoincrement=True),
            sa.Column("serial", sa.String(200), nullable=False, index=True),
            sa.Column("procedure", sa.String(40), nullable=False),
            sa.Column("date", sa.String(80), nullable=False),
            sa.Column("created", sa.String(40), nullable=False),
            sa.Column("software", sa.String(80), nullable=False),
            sa.Column("content_sha256", sa.String(64), nullable=False),
            sa.Column("sources_sha256", sa.String(64), nullable=False),
            sa.Column("degrees_of_freedom", sa.Double),
            sa.Column("warnings", sa.Text, nullable=False),
            sa.UniqueConstraint("serial", "procedure", "content_sha256"),
        )
        self._parameters = sa.Table(
            "imulab_parameters",
            tables,
            sa.Column("calibration", sa.ForeignKey("imulab_calibrations.id"), primary_key=True),
            sa.Column("name", sa.String(120), primary_key=True),
            sa.Column("value", sa.Double, nullable=False),
            sa.Column("standard_uncertainty", sa.Double),
            sa.Column("unit", sa.String(80), nullable=False),
        )
        try:
            tables.create_all(engine)
        except sa.exc.DatabaseError:  # a run that began at the same moment has made them: seen by a second look
            tables.create_all(engine)
        with engine.connect() as connection:  # a table of this name that is another's is refused before the work
            for table in (self._calibrations, self._parameters):
                connection.execute(sa.select(table).limit(0))

    def add(self, summaries: Sequence[Summary]) -> None:
        """Add the calibrations that the history lacks, all or none."""
        if not summaries:
            return
        from importlib import import_module

        dialect = import_module(f"sqlalchemy.dialects.{self._engine.dialect.name}")
        insert = dialect.insert(self._calibrations).on_conflict_do_nothing().returning(self._calibrations.c.id)
        rows: list[dict[str, Any]] = []
        with _in_one_line(self._name, self._url), self._engine.begin() as connection:
            # In one order: runs that add the same calibrations at once would wait for each other otherwise.
            for summary in sorted(summaries, key=lambda summary: summary.serial):
                calibration = connection.execute(
                    insert,
                    {
                        "serial": summary.serial,
                        "procedure": summary.procedure,
                        "date": summary.when,
                        "created": summary.created,
                        "software": summary.software,
                        "content_sha256": summary.content_sha256,
                        "sources_sha256": sources_of(summary),
                        "degrees_of_freedom": summary.freedom,
                        "warnings": json.dumps(summary.warnings, ensure_ascii=False),
                    },
                ).scalar()
                if calibration is not None:
                    rows += (
                        {
                            "calibration": calibration,
                            "name": name,
                            "value": p.value,
                            "standard_uncertainty": p.standard_uncertainty,
                            "unit": p.unit,
                        }
                        for name, p in summary.parameters.items()
                    )
            if rows:
                connection.execute(self._parameters.insert(), rows)

    def of(self, serials: Sequence[str]) -> dict[str, list[Past]]:
        """Return the calibrations of these units, oldest first."""
        import sqlalchemy as sa

        c, p = self._calibrations.c, self._parameters.c
        calibrations: dict[int, Past] = {}
        values: dict[int, dict[str, Parameter]] = {}
        with _in_one_line(self._name, self._url), self._engine.connect() as connection:
            for start in range(0, len(serials), _SERIALS_AT_ONCE):
                query = (
                    sa.select(
                        c.id, c.serial, c.procedure, c.date, c.created, c.content_sha256, c.sources_sha256,
                        c.degrees_of_freedom,
                        p.name, p.value, p.standard_uncertainty, p.unit,
                    )
                    .select_from(self._calibrations.outerjoin(self._parameters))
                    .where(c.serial.in_(serials[start : start + _SERIALS_AT_ONCE]))
                    .order_by(c.created, c.id)
                )  # fmt: skip
                for row in connection.execute(query):
                    parameters = values.setdefault(row.id, {})
                    if row.name is not None:
                        parameters[row.name] = Parameter(row.value, row.standard_uncertainty, row.unit)
                    if row.id not in calibrations:
                        calibrations[row.id] = Past(
                            row.serial, row.procedure, row.date, row.created, row.content_sha256, row.sources_sha256,
                            parameters, row.degrees_of_freedom,
                        )  # fmt: skip
        past: dict[str, list[Past]] = {}
        for item in calibrations.values():
            past.setdefault(item.serial, []).append(item)
        return past


@contextmanager
def open_history(url: str, *, there: bool = False) -> Iterator[History]:
    """Open a history by its SQLAlchemy URL (``sqlite:///FILE``, ``postgresql://USER@HOST/DATABASE``); make its tables.

    With `there`, a SQLite file that is not there is refused, not made.

    Raises
    ------
    OptionError
        SQLAlchemy or the database's driver is missing, or the database cannot be used.
    """
    try:
        import sqlalchemy as sa
        from sqlalchemy.exc import SQLAlchemyError
    except ImportError:
        raise OptionError(f"the history needs SQLAlchemy: {install('fleet')}") from None
    expected = "expected a URL such as sqlite:///history.sqlite or postgresql://user@host/database"
    try:
        address = sa.make_url(url)
    except (SQLAlchemyError, ValueError):  # a port that is no number
        raise OptionError(f"history {masked(url)!r}: {expected}") from None
    name = masked(url)
    if address.username is not None:  # which is no secret of a database, as it may be of a file's address
        login = address.username if address.password is None else f"{address.username}:***"
        name = name.replace("://***@", f"://{login}@", 1)
    kind = address.get_backend_name()
    if kind not in ("sqlite", "postgresql"):
        raise OptionError(f"history {name}: {expected}")
    if there and kind == "sqlite" and not Path(address.database or "").is_file():
        raise OptionError(f"history {name}: no such file")
    if address.drivername == "postgresql":
        address = address.set(drivername="postgresql+psycopg")
    with _in_one_line(name, url, opening=True):
        try:
            engine = sa.create_engine(address, connect_args={"timeout" if kind == "sqlite" else "connect_timeout": 20})
        except ImportError as error:
            raise OptionError(f"history {name}: its driver is missing ({error}): {install('postgres')}") from None
    try:
        with _in_one_line(name, url, opening=True):
            history = History(engine, name, url)
        yield history
    finally:
        engine.dispose()


@contextmanager
def _in_one_line(name: str, url: str, *, opening: bool = False) -> Iterator[None]:
    """Raise a refusal of the database as an error of one line; drivers refuse options of a URL in their own ways."""
    from sqlalchemy.exc import SQLAlchemyError

    try:
        yield
    except (SQLAlchemyError, TypeError, ValueError) as error:
        if not (opening or isinstance(error, SQLAlchemyError)):
            raise
        reason = without_secrets(" ".join(str(getattr(error, "orig", None) or error).split()), url)[:300]
        raise OptionError(f"history {name}: {reason}") from None
