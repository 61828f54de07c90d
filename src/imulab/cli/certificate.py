"""The certificate that a laboratory hands out, from a record."""

from __future__ import annotations

from typing import Annotated

import imulab as il
from imulab.cli.command import Command, option
from imulab.cli.options import RecordFile, check_outputs
from imulab.options import OUTPUT


def certificate(
    record: RecordFile,
    *,
    lab: Annotated[str, option("LAB.toml", "Who issues it: laboratory, customer, persons, method, traceability.")],
    output: Annotated[str, option("CERT.xml", "Certificate to write.", "-o", "--output"), OUTPUT],
) -> None:
    """Write a Digital Calibration Certificate.

    PTB's DCC 3.3.0 for other programs: values, uncertainties and covariances from the record, persons and places from
    LAB.toml. What is missing is refused, and nothing is written then.
    """
    check_outputs([output], [record, lab])
    il.write_certificate(record, output, lab=lab)
    print(f"certificate: {output}")


COMMANDS = (Command("certificate", certificate),)
