"""The certificate that a laboratory hands out, from a record."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Literal

import imulab as il
from imulab.cli.command import Argument, Command, option
from imulab.cli.options import check_outputs, warn
from imulab.errors import OptionError
from imulab.files import replacing
from imulab.options import OUTPUT, choice


def certificate(
    record: Annotated[str | None, Argument("RECORD", "Calibration record.")] = None,
    *,
    lab: Annotated[
        str | None, option("LAB.toml", "Who issues it: laboratory, customer, persons, method, traceability.")
    ] = None,
    limits: Annotated[
        str | None, option("LIMITS.toml", "Limits of parameters: whether each conforms, by the rule in LAB.toml.")
    ] = None,
    before: Annotated[
        str | None, option("RECORD", "The unit's record from before it was adjusted; both are certified.")
    ] = None,
    language: Annotated[
        Literal["en", "de"] | None, choice(("en", "de"), help="Language of the texts; else that of LAB.toml.")
    ] = None,
    fonts: Annotated[str | None, option("DIR", "Fonts for letters that those of the PDF lack.")] = None,
    sign: Annotated[
        str | None, option("KEY.pem", "Private key and its certificate, by which the XML is signed.")
    ] = None,
    output: Annotated[
        str | None, option("CERT.xml|CERT.pdf", "Certificate to write.", "-o", "--output"), OUTPUT
    ] = None,
    template: Annotated[
        bool, option("", "Print a LAB.toml to start from, or write it to the output, and nothing else."), OUTPUT
    ] = False,
) -> None:
    """Write a certificate for people and for programs.

    Of a record: a PDF/A-3 with a Digital Calibration Certificate (PTB DCC 3.3.0) attached, or that XML alone. Values,
    uncertainties and covariances are the record's, persons and places those of LAB.toml. What is missing is refused,
    and nothing is written then.
    """
    if template:
        from imulab.certificate.laboratory import TEMPLATE

        if output is None:
            print(TEMPLATE, end="")
            return
        if not output.lower().endswith(".toml"):
            raise OptionError(f"{output}: the template is TOML; expected a name that ends in .toml")
        check_outputs([output], [])
        with replacing(output) as stream:
            stream.write(TEMPLATE.encode())
        print(f"template: {output}")
        return
    if record is None or lab is None or output is None:
        raise OptionError("expected RECORD, --lab LAB.toml and -o CERT.pdf, or --template alone")
    check_outputs([output], [each for each in (record, lab, limits, before, sign) if each], paper=True)
    il.write_certificate(
        record, output, lab=lab, limits=limits, before=before, language=language, fonts=fonts, sign=sign
    )
    print(f"certificate: {output}")
    from imulab.certificate.laboratory import day_remarks, template_remarks
    from imulab.procedures.registry import load

    certified = load(record)
    remarks = template_remarks(lab, certified.parameters, tumbled=certified.procedure == "tumble")
    for remark in [*remarks, *day_remarks(lab, certified.created, datetime.now(UTC).date())]:
        warn(remark)


COMMANDS = (Command("certificate", certificate),)
