"""Certificates as PDFs: what is printed, that the XML is inside, for archives and screen readers, refusals by name."""

import shutil
import sys
from dataclasses import replace
from decimal import Decimal
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

import imulab as il
from imulab.certificate.dcc import dcc_xml
from imulab.certificate.digits import printed_unit, rounded, significant, smaller_units
from imulab.certificate.laboratory import TEMPLATE, load_laboratory
from imulab.certificate.model import make_certificate, with_before
from imulab.certificate.texts import _TEXTS
from imulab.cli import main
from imulab.procedures.registry import load_sealed
from imulab.recording import Source

pytest.importorskip("typst", reason="typst lays out certificates")
pypdf = pytest.importorskip("pypdf", reason="pypdf reads their PDF")

DATA = Path(__file__).resolve().parent / "data"
LAB = (DATA / "lab.toml").read_text(encoding="utf-8")
REVIEWED = LAB.replace("location =", 'reviewed = "seen and understood"\nlocation =')
RULE = '[conformity]\nrule = "bands"\nagreed = "offer 2026-118"\nspecification = "data sheet DS-0815, table 2"\n'
LIMITS = '[tumble]\n"bias_*" = { lower = -20, upper = 20, unit = "mg" }\n'
WRITTEN = DATA / "written_by" / "0.2.0"
HOSTILE = '#panic() *b* $x$ <b> _i_ \\ @ref `raw` // = "q" שלום'


def texts(pdf):
    """The text of each page, with single spaces."""
    return [" ".join(page.extract_text().split()) for page in pypdf.PdfReader(BytesIO(pdf)).pages]


@pytest.fixture
def printed(tmp_path, monkeypatch):
    """A function that certifies a record of those written by 0.2.0 as a PDF by the command, and returns its bytes."""
    monkeypatch.chdir(tmp_path)

    def run(lab=REVIEWED, name="tumble", *further, limits=None, output="cert.pdf"):
        Path("lab.toml").write_text(lab, encoding="utf-8")
        if limits is not None:
            Path("limits.toml").write_text(limits, encoding="utf-8")
            further = (*further, "--limits", "limits.toml")
        status = main(["certificate", str(WRITTEN / f"{name}.json"), "--lab", "lab.toml", *further, "-o", output])
        return Path(output).read_bytes() if status == 0 else status

    return run


ITEMS = (
    "Calibration certificate", "EX-2026-0042", "Example Inertial Laboratory (D-K-00000-00-00)", "Plumb Line 1",
    "Propeller Road, 54321 Hovertown", "order PO-7781", "Accelerometer triad", "Example Sensors AG", "Serial number",
    "as received", "Received 2026-11-20", "Calibrated 2026-11-24", "Place of calibration laboratory",
    "Issued 2026-11-27", "Multi-position tumble calibration", "QP-ACC-01, issue 3", "Deviations none",
    "Ambient temperature (23.00 ± 0.50) °C", "Gravity is traceable to the SI", "Reviewed: seen and understood",
    "The results relate only to the item calibrated", "must not be reproduced except in full", "A. Example",
    "Head of laboratory", "U = k u is the expanded uncertainty", "Statement of conformity", "by the rule bands",
    "End of the certificate",
)  # fmt: skip


def test_every_item_of_the_standard_is_printed(printed):
    pages = texts(printed(REVIEWED + RULE, limits=LIMITS))
    whole = " ".join(pages)
    assert [item for item in ITEMS if item not in whole] == []
    record = il.load(WRITTEN / "tumble.json")
    assert [name for name in record.parameters if name not in whole] == []
    assert record.sensor["serial"] in whole
    assert 2 <= len(pages) <= 4
    for number, page in enumerate(pages, start=1):
        assert "Calibration certificate EX-2026-0042" in page
        assert f"Page {number} of {len(pages)}" in page


def test_the_xml_is_inside_as_it_would_be_alone(printed):
    pdf = printed()
    xml = printed(output="cert.xml")
    reader = pypdf.PdfReader(BytesIO(pdf))
    assert reader.attachments["certificate.xml"] == [xml]
    described = reader.trailer["/Root"]["/AF"][0].get_object()
    assert described["/AFRelationship"] == "/Alternative"


def test_it_is_for_archives_and_screen_readers_and_the_same_twice(printed):
    pdf = printed()
    assert printed(output="again.pdf") == pdf
    metadata = pypdf.PdfReader(BytesIO(pdf)).xmp_metadata.stream.get_data().decode()
    for said in ("<pdfaid:part>3<", "<pdfaid:conformance>A<", "<pdfuaid:part>1<"):
        assert said in metadata
    assert pypdf.PdfReader(BytesIO(pdf)).trailer["/Root"]["/Lang"] == "en"


def test_texts_are_printed_as_they_are(printed):
    lab = REVIEWED.replace('"as received"', f"'{HOSTILE}'")
    whole = " ".join(texts(printed(lab)))
    for word in HOSTILE.split()[:-1]:
        assert word in whole
    assert "שלום" in whole or "שלום"[::-1] in whole  # as the reader orders letters
    assert "Example Drones <b>Ltd</b> & Söhne" in whole


@pytest.mark.parametrize("where", ["laboratory", "customer"])
def test_a_letter_that_no_font_has_is_named(printed, capsys, where):
    lab = REVIEWED.replace(f'[{where}]\nname = "Example', f'[{where}]\nname = "漢字 Example')
    assert printed(lab) == 2
    error = capsys.readouterr().err
    assert error.startswith(
        f"imulab: lab.toml: {where}.name: no font of the PDF has the letter '漢' (U+6F22); expected --fonts"
    )
    assert error.count("\n") == 1
    assert not Path("cert.pdf").exists()
    assert printed(lab, output="cert.xml")  # which takes every letter


def test_further_fonts_have_further_letters(printed, capsys):
    """Tifinagh is in DejaVu Sans, not in the fonts that typst brings."""
    lab = REVIEWED.replace("A. Example", "ⵣ. Example")
    assert printed(lab) == 2
    assert "lab.toml: persons 1: name: no font of the PDF has the letter 'ⵣ' (U+2D63)" in capsys.readouterr().err
    assert printed(lab, "tumble", "--fonts", "nowhere") == 2
    assert "fonts 'nowhere': expected a folder of fonts" in capsys.readouterr().err
    if not Path("/usr/share/fonts/truetype/dejavu/DejaVuSans.ttf").is_file():
        pytest.skip("no DejaVu Sans on this machine (Debian package fonts-dejavu-core)")
    assert "ⵣ. Example" in " ".join(texts(printed(lab, "tumble", "--fonts", "/usr/share/fonts/truetype/dejavu")))


def test_without_typst_it_says_what_is_missing(printed, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "typst", None)
    assert printed() == 2
    assert "a PDF needs typst, which is not here: pip install '.[certificate]'" in capsys.readouterr().err
    assert not Path("cert.pdf").exists()


GERMAN = ("Kalibrierschein", "Ergebnisse", "Konformität", "Seite 1 von", "Geprüft: seen and understood", "bestanden",
          "(23,00 ± 0,50) °C", "U = k u ist die erweiterte Messunsicherheit", "Ende des Kalibrierscheins")  # fmt: skip


def test_german_has_commas_and_every_text(printed):
    whole = " ".join(texts(printed(REVIEWED + RULE, "tumble", "--language", "de", limits=LIMITS)))
    assert [text for text in GERMAN if text not in whole] == []
    english = {each[0] for each in _TEXTS.values()} - {each[1] for each in _TEXTS.values()}
    assert [text for text in english if len(text) > 12 and text in whole] == []


def test_each_text_has_the_same_places_in_both_languages():
    assert [key for key, (en, de) in _TEXTS.items() if en.count("{}") != de.count("{}") or not de] == []


OTHERS = ("nine_axes", "thermal", "thermal_gyro", "rate", "turns", "noise", "warmup", "centrifuge", "array")


@pytest.mark.parametrize("name", [*OTHERS, "magnetometer"])
def test_records_of_other_procedures_are_printed(printed, name):
    if name == "magnetometer":
        record = il.fit_magnetometer(il.simulate_magnetometer()).calibration
    else:
        record = il.load(WRITTEN / f"{name}.json")
    record = replace(record, sensor={**record.sensor, "serial": "SN-1"})
    record.save("unit.json")
    whole = " ".join(texts(printed(REVIEWED, Path("unit").absolute())))
    known = [key for key, each in record.parameters.items() if each.standard_uncertainty]
    assert known
    assert [key for key in known if key not in whole.replace(" ", "")] == []
    assert "SN-1" in whole


# Before the adjustment, and certificates that replace others.


@pytest.fixture
def adjusted(tmp_path, monkeypatch):
    """Paths of two records of one unit, and of a LAB.toml that replaces a certificate."""
    monkeypatch.chdir(tmp_path)
    record = il.load(WRITTEN / "tumble.json")
    record.save("after.json")
    replace(record, created="2026-11-19T12:00:00Z", warnings=()).save("before.json")
    amended = 'replaces = "EX-2026-0041"\nreason = "wrong address"\nlanguage = "de"\nlocation ='
    Path("lab.toml").write_text(REVIEWED.replace("location =", amended), encoding="utf-8")
    return ["certificate", "after.json", "--lab", "lab.toml", "--before", "before.json"]


def test_both_results_stand_in_the_certificate(adjusted, real_data):
    assert main([*adjusted, "-o", "cert.pdf"]) == 0
    pdf = Path("cert.pdf").read_bytes()
    whole = " ".join(texts(pdf))
    for text in ("Ergebnisse, vor der Justierung", "Ergebnisse, nach der Justierung", "Grund: wrong address"):
        assert text in whole
    xml = pypdf.PdfReader(BytesIO(pdf)).attachments["certificate.xml"][0].decode()
    assert xml.count("<dcc:measurementResult>") == 2
    assert xml.index("beforeAdjustment") < xml.index("afterAdjustment")
    assert "<dcc:replacedUniqueIdentifier>EX-2026-0041<" in xml
    schema = pytest.importorskip("xmlschema", reason="xmlschema checks certificates")
    path = real_data / "dcc" / "dcc" / "v3.3.0.xsd"
    schema.XMLSchema(str(path)).validate(xml)


def test_a_record_of_another_unit_or_the_same_is_not_before(adjusted, capsys):
    assert main([*adjusted[:-1], "after.json", "-o", "cert.pdf"]) == 2
    assert "before: the same record" in capsys.readouterr().err
    replace(il.load("after.json"), sensor={"serial": "SN-9"}).save("other.json")
    assert main([*adjusted[:-1], "other.json", "-o", "cert.pdf"]) == 2
    assert "before: serial 'SN-9'; expected" in capsys.readouterr().err
    assert not Path("cert.pdf").exists()


def test_a_record_measured_after_the_adjustment_is_not_before(adjusted, capsys):
    for name, day in (("after", "2026-11-24"), ("before", "2026-11-25")):
        replace(il.load(f"{name}.json"), sources=(Source(f"{name}.csv", "0" * 64, day),)).save(f"{name}.json")
    lab = Path("lab.toml")
    days = "[2026-11-24, 2026-11-25]"
    lab.write_text(lab.read_text(encoding="utf-8").replace("[2026-11-24, 2026-11-24]", days), encoding="utf-8")
    assert main([*adjusted, "-o", "cert.xml"]) == 2
    assert "before: measured 2026-11-25, after 2026-11-24" in capsys.readouterr().err
    assert not Path("cert.xml").exists()


def test_what_replaces_says_why(printed, capsys):
    assert printed(REVIEWED.replace("location =", 'replaces = "EX-1"\nlocation =')) == 2
    assert "certificate: expected replaces and reason together" in capsys.readouterr().err


LOGO = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 4 2"><rect width="4" height="2" fill="#135"/></svg>'


def test_a_logo_lies_beside_the_file(printed, capsys):
    lab = REVIEWED.replace("\ncode =", '\nlogo = "logo.svg"\ncode =')
    assert printed(lab) == 2
    assert "laboratory.logo 'logo.svg': no such file beside it" in capsys.readouterr().err
    Path("logo.svg").write_text(LOGO, encoding="utf-8")
    assert len(printed(lab)) > 10_000
    Path("logo.png").write_bytes(b"no picture")
    assert printed(lab.replace("logo.svg", "logo.png")) == 2
    assert (
        "imulab: lab.toml: laboratory.logo: the PDF cannot be laid out: failed to decode image"
        in capsys.readouterr().err
    )
    assert printed(lab.replace("logo.svg", "lab.toml")) == 2
    assert "expected a name that ends with .png, .jpg or .svg" in capsys.readouterr().err


# Numbers.


@pytest.mark.parametrize(
    ("value", "uncertainty", "expected"),
    [
        (1.25, 0.5, ("1.25", "0.50", 0)),
        (-0.0004, 0.1, ("0.00", "0.10", 0)),
        (1.0, 0.0996, ("1.00", "0.10", 0)),
        (0.125, 0.25, ("0.13", "0.25", 0)),
        (-0.125, 0.25, ("-0.13", "0.25", 0)),
        (12345678.0, 12000.0, ("12.346", "0.012", 6)),
        (4.1e-4, 1.2e-7, ("410.00", "0.12", -6)),
        (5e-324, 1e100, ("0", "10", 99)),
    ],
)
def test_uncertainties_have_two_digits_and_values_end_there(value, uncertainty, expected):
    (text,), spread, power = rounded([value], uncertainty)
    assert (text, spread, power) == expected


def test_rounding_moves_nothing_that_matters():
    rng = np.random.default_rng(4)
    for _ in range(4_000):
        u = float(10 ** rng.uniform(-12, 12))
        y = float(u * rng.normal() * 10 ** rng.uniform(-2, 6))
        (text,), spread, power = rounded([y], u)
        unit = Decimal(10) ** power
        assert abs(Decimal(spread) * unit / Decimal(u) - 1) < Decimal("0.05")
        assert abs(Decimal(text) * unit - Decimal(y)) <= Decimal("0.0505") * Decimal(u)
        assert text.strip("-0.") or not text.startswith("-")
        assert len(spread.replace(".", "").lstrip("0").rstrip("0")) <= 2


def test_units_and_factors_are_read_by_people():
    assert printed_unit("rad/s/sqrt(Hz)") == "rad/s/√Hz"
    assert printed_unit("uT/T") == "µT/T"
    assert significant(2.0478, 3) == "2.05"
    assert significant(2.0, 3) == "2.00"
    assert smaller_units([("m/s^2", 0.3), ("rad", 2.0), ("m/s^2", -0.4)]) == {"m/s^2": ("mm/s²", -3), "rad": ("rad", 0)}


def test_both_files_come_from_one_model(tmp_path):
    (tmp_path / "lab.toml").write_text(REVIEWED, encoding="utf-8")
    lab = load_laboratory(str(tmp_path / "lab.toml"))
    made = make_certificate(*load_sealed(WRITTEN / "tumble.json"), lab)
    other = replace(made, sha256="0" * 64)
    assert dcc_xml(with_before(made, other)).count(b"beforeparameter_1 ") == 1


# Of a fleet.


@pytest.fixture(scope="module")
def line(made_once):
    """The folder of two units that were calibrated on 2 and 3 March 2026, and of one that was not measured."""

    def fill(folder):
        first, _ = il.simulate_fleet(folder, units=8, rate="15 Hz")
        rows = first.read_text(encoding="utf-8").splitlines()
        first.write_text("\n".join([*rows[:3], rows[3].replace("first_0003", "nothing")]) + "\n", encoding="utf-8")
        il.run_fleet(first, folder / "records", workers=1)

    return made_once("certified_line", fill)


@pytest.fixture
def issue_all(line, tmp_path, monkeypatch):
    """A function that certifies the fleet by a LAB.toml, and returns the exit status."""
    monkeypatch.chdir(tmp_path)

    def run(
        number="EX-{serial}", days="[2026-03-01, 2026-03-31]", change=("x", "x"), options=(), folder=line / "records"
    ):
        lab = REVIEWED.replace("EX-2026-0042", number).replace("[2026-11-24, 2026-11-24]", days).replace(*change)
        Path("lab.toml").write_text(lab.replace("received = 2026-11-20\n", ""), encoding="utf-8")
        return main(["fleet", "certificate", str(folder), "--lab", "lab.toml", *options, "-o", "out"])

    return run


def test_every_unit_of_a_fleet_has_its_certificate(issue_all, capsys):
    assert issue_all() == 2
    said = capsys.readouterr()
    assert "certificates: 2 in out\nnone: LINE-0003: it has no record: nothing.csv: " in said.out
    assert "\nimulab: 1 of 3 units have no certificate: LINE-0003: " in said.err
    assert sorted(path.name for path in Path("out").iterdir()) == [
        f"LINE-000{unit}.{ending}" for unit in (1, 2) for ending in ("pdf", "xml")
    ]
    for unit, day in ((1, "2026-03-02"), (2, "2026-03-03")):
        pdf = Path(f"out/LINE-000{unit}.pdf").read_bytes()
        assert f"EX-LINE-000{unit}" in texts(pdf)[0]
        assert f"Calibrated {day} Place" in texts(pdf)[0]
        xml = Path(f"out/LINE-000{unit}.xml").read_bytes()
        assert pypdf.PdfReader(BytesIO(pdf)).attachments["certificate.xml"] == [xml]
        assert f"<dcc:endPerformanceDate>{day}<".encode() in xml


def test_a_fleet_needs_numbers_of_their_own_and_days_that_hold(issue_all, capsys):
    assert issue_all(number="EX-1") == 2
    assert "lab.toml: certificate.number 'EX-1': expected {serial} in it" in capsys.readouterr().err
    assert not Path("out").exists()
    assert issue_all(days="[2026-03-03, 2026-03-31]") == 2
    assert "LINE-0001" in capsys.readouterr().err
    assert [path.name for path in sorted(Path("out").glob("*.pdf"))] == ["LINE-0002.pdf"]


@pytest.mark.parametrize(
    ("change", "options", "expected"),
    [
        (
            ('"degC"', '"furlong"'),
            [],
            "conditions Ambient temperature: unit furlong: the D-SI of certificates has no name",
        ),
        (
            ("condition =", 'serial = "S1"\ncondition ='),
            [],
            "item.serial 'S1': each unit of a fleet has its own; leave it",
        ),
        (("x", "x"), ["--limits", "limits.toml"], "limits.toml: limits need a rule that the customer agreed to"),
        (("A. Example", "漢"), [], "lab.toml: persons 1: name: no font of the PDF has the letter '漢'"),
        (("x", "x"), ["--fonts", "nowhere"], "fonts 'nowhere': expected a folder of fonts"),
        (("x", "x"), ["--sign", "nothing.pem"], "nothing.pem"),
    ],
)
def test_what_is_wrong_for_every_unit_is_said_once_and_nothing_is_written(issue_all, capsys, change, options, expected):
    assert issue_all(change=change, options=options) == 2
    said = capsys.readouterr()
    assert expected in said.err
    assert (said.out, said.err.count("\n")) == ("", 1)
    assert not Path("out").exists()


def test_the_day_of_issue_is_compared_with_the_latest_record(line, issue_all, tmp_path, capsys):
    shutil.copytree(line / "records", tmp_path / "records")
    record = il.load("records/LINE-0002.json")
    replace(record, created="2099-01-02T00:00:00Z").save("records/LINE-0002.json")
    assert issue_all(folder="records") == 2  # one has no record
    assert ": before the record was made, on 2099-01-02; expected a later day" in capsys.readouterr().err


def test_an_empty_folder_that_was_there_before_is_kept(issue_all):
    Path("out").mkdir()
    assert issue_all(change=("A. Example", "漢")) == 2
    assert not list(Path("out").iterdir())


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (None, "limits.toml: no such limits file"),
        ('[tumble]\nbias_q = { upper = 20, unit = "mg" }\n', "limits.toml: tumble: no parameter 'bias_q'"),
        ('[tumble]\nbias_x = { upper = 20, unit = "mV" }\n', "limits.toml: tumble: bias_x: unit 'mV'"),
        ('[noise]\naccel_x_white = { upper = 20, unit = "ug/sqrt(Hz)" }\n', "limits.toml: no limits of a parameter of"),
    ],
    ids=["no file", "no such parameter", "other unit", "other procedure"],
)
def test_limits_that_are_wrong_for_every_unit_are_refused_once(issue_all, capsys, content, expected):
    if content is not None:
        Path("limits.toml").write_text(content, encoding="utf-8")
    assert issue_all(change=("[laboratory]", RULE + "[laboratory]"), options=["--limits", "limits.toml"]) == 2
    said = capsys.readouterr()
    assert expected in said.err
    assert (said.out, said.err.count("\n")) == ("", 1)
    assert not Path("out").exists()


def test_a_unit_whose_pdf_is_refused_has_no_xml_either(line, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(line / "records", "records")
    record = il.load("records/LINE-0002.json")
    replace(record, sensor={**record.sensor, "model": "漢"}).save("records/LINE-0002.json")
    lab = REVIEWED.replace("EX-2026-0042", "EX-{serial}").replace(
        "[2026-11-24, 2026-11-24]", "[2026-03-01, 2026-03-31]"
    )
    Path("lab.toml").write_text(lab.replace("received = 2026-11-20\n", ""), encoding="utf-8")
    assert main(["fleet", "certificate", "records", "--lab", "lab.toml", "-o", "out"]) == 2
    assert "none: LINE-0002: the record: no font of the PDF has the letter '漢'" in capsys.readouterr().out
    assert sorted(path.name for path in Path("out").iterdir()) == ["LINE-0001.pdf", "LINE-0001.xml"]


def test_a_fleet_is_warned_of_the_template_by_what_its_records_hold(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    il.write(il.simulate_tumble(attitudes=12, order=1, gyro=True), "tumble.csv")
    il.simulate_thermal("-20,0,25,45,60", attitudes=10).save("thermal")
    lab = TEMPLATE.replace("EX-2026-0042", "EX-{serial}").replace("location =", 'reviewed = "seen"\nlocation =')
    tumble = "tumble,tumble.csv,9.80665+-0.00002,1"
    thermal = ";".join(map(str, sorted(Path("thermal").glob("*.csv"))))
    Path("lab.toml").write_text(lab, encoding="utf-8")
    for row, holds in (
        (f"{tumble},", None),
        (f"{tumble},gyro", "bias_x, bias_y, bias_z and "),
        (f"thermal,{thermal},9.80665+-0.00002,,", "bias_x, bias_x_t1, "),
    ):
        Path("fleet.csv").write_text(f"serial,procedure,file,gravity,order,with\nA1,{row}\n", encoding="utf-8")
        il.run_fleet("fleet.csv", "records", workers=1)
        capsys.readouterr()
        assert main(["fleet", "certificate", "records", "--lab", "lab.toml", "-o", "out"]) == 0
        said = capsys.readouterr().err
        assert ("'Multi-position tumble calibration in the local gravity field'" in said) == (holds is not None)
        assert holds is None or f"that were tumbled; the record holds {holds}" in said
