"""Certificates: valid by PTB's schemas, every number of the record in them bit for bit, refusals write nothing."""

import json
import math
import re
import tomllib
from contextlib import suppress
from copy import deepcopy
from dataclasses import replace
from datetime import date
from functools import reduce
from operator import getitem
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal, multivariate_t

import imulab as il
import imulab.certificate.laboratory as laboratory_file
from imulab.certificate.dcc import dcc_xml
from imulab.certificate.laboratory import TEMPLATE, day_remarks, load_laboratory
from imulab.certificate.model import make_certificate
from imulab.certificate.units import dsi_unit
from imulab.cli import main
from imulab.display import Verdict
from imulab.errors import UnitError
from imulab.fleet.limits import Limits, decide, probability_of_all
from imulab.recording import Source
from imulab.records.calibration import Calibration, Covariance, Parameter

LAB = (Path(__file__).resolve().parent / "data" / "lab.toml").read_text(encoding="utf-8")
STANDARD = """
[[equipment]]
name = "Local gravity value"
quantity = "gravity"
certificate = "GRAV-2024-017"
issuer = "Example Institute"
standard_uncertainty = { value = 1e-6, unit = "m/s^2" }
"""
REVIEWED = LAB.replace("location =", 'reviewed = "seen and understood"\nlocation =')
WRITTEN = Path(__file__).resolve().parent / "data" / "written_by" / "0.2.0"
NAMES = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"}


@pytest.fixture(scope="module")
def sound(made_once):
    """A folder with the good record of a tumble test, whose gravity is known to 1e-6 m/s^2."""
    recording = il.simulate_tumble(gravity=9.81362)
    return made_once(
        "certified", lambda folder: il.fit_tumble(recording, gravity="9.81362+-0.000001").save(folder / "sound.json")
    )


@pytest.fixture
def issue(tmp_path, monkeypatch, sound):
    """A function that runs the command on a record and a LAB.toml, and returns its exit status."""
    monkeypatch.chdir(tmp_path)

    def run(lab=LAB + STANDARD, record=sound / "sound.json", output="cert.xml", limits=None):
        Path("lab.toml").write_text(lab, encoding="utf-8")
        further = []
        if limits is not None:
            Path("limits.toml").write_text(limits, encoding="utf-8")
            further = ["--limits", "limits.toml"]
        return main(["certificate", str(record), "--lab", "lab.toml", *further, "-o", output])

    return run


@pytest.fixture(scope="module")
def schemas(real_data):
    """PTB's schema by two libraries, from files alone."""
    etree = pytest.importorskip("lxml.etree", reason="lxml checks certificates")
    xmlschema = pytest.importorskip("xmlschema", reason="xmlschema checks certificates")
    path = real_data / "dcc" / "dcc" / "v3.3.0.xsd"
    if not path.exists():
        pytest.skip("PTB's schemas are not here (IMULAB_DATA)")
    first, second = etree.XMLSchema(etree.parse(path)), xmlschema.XMLSchema(str(path))

    def mistakes(file):
        tree = etree.parse(file)
        first.validate(tree)
        return [str(error) for error in first.error_log] + [error.reason for error in second.iter_errors(str(file))]

    return mistakes


@pytest.mark.slow
def test_the_certificate_of_a_tumble_record_is_valid(issue, schemas):
    assert issue() == 0
    assert schemas("cert.xml") == []


OTHERS = ("nine_axes", "thermal", "thermal_gyro", "rate", "turns", "warmup", "centrifuge", "array", "noise")


@pytest.mark.parametrize("name", [*OTHERS, "magnetometer"])
def test_certificates_of_other_procedures_are_valid_and_shown(issue, schemas, capsys, name):
    if name == "magnetometer":
        record = il.fit_magnetometer(il.simulate_magnetometer()).calibration
    else:
        record = il.load(WRITTEN / f"{name}.json")
    replace(record, sensor={**record.sensor, "serial": "SN-1"}).save("unit.json")
    assert issue(REVIEWED, "unit.json") == 0
    assert schemas("cert.xml") == []
    stated = {name: p for name, p in record.parameters.items() if p.standard_uncertainty}
    assert len(_single("cert.xml")) == len(stated)
    capsys.readouterr()
    assert main(["show", "cert.xml"]) == 0
    rows = re.findall(r"^(\w+) +(\S+) +(\S+(?: … \S+)?) +(\S+) +(×10\S+)? ?", capsys.readouterr().out, re.M)
    superscripts = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
    for parameter, value, expanded, _, power in rows:
        if parameter in stated:
            ten = 10.0 ** int(power[3:].translate(superscripts)) if power else 1.0
            u = stated[parameter].standard_uncertainty if "…" in expanded else ten * float(expanded)
            assert ten * float(value) == pytest.approx(stated[parameter].value, abs=0.0501 * u)
    assert len([row for row in rows if row[0] in stated]) == len(stated)


@pytest.mark.parametrize("known", [False, True])
def test_a_certificate_of_an_array_says_that_its_scale_factors_are_relative(issue, known):
    """Gyros whose scale is 5 % off: their ratios to the mean are known to 1e-5, which U must not be taken for."""
    rng = np.random.default_rng(4)
    time = np.arange(6000) / 100
    rate = 90 * np.sin(0.9 * time) + 60 * np.sin(2.3 * time)
    gain, zero = 1.05 + 0.01 * rng.standard_normal(5), 0.1 * rng.standard_normal(5)
    still, moving = (
        {f"gyro_{i + 1}": gain[i] * w + zero[i] + 0.05 * rng.standard_normal(6000) for i in range(5)}
        for w in (0 * time, rate)
    )
    units = {"time": "s", **dict.fromkeys(still, "deg/s")}
    if known:
        moving["truth_rate"], units["truth_rate"] = rate, "deg/s"
    recordings = [
        il.Recording({"time": time, **columns}, {k: units[k] for k in ("time", *columns)}, metadata={"serial": "A1"})
        for columns in (still, moving)
    ]
    fit = il.calibrate_array(*recordings)
    fit.save("array.json")
    off = abs(fit.calibration.parameters["scale_factor_1"].value - gain[0])
    assert (off < 1e-4) == known
    assert issue(REVIEWED, "array.json") == 0
    text = Path("cert.xml").read_text(encoding="utf-8")
    assert ("Scale factors and alignment are relative to the mean of all elements" in text) != known
    assert "The Earth's rate, up to 15 deg/h along an axis, was not taken off" in text
    slower = f"could make them up to {fit.calibration.fit['slower_noise']:.2g} times as large"
    assert sum(slower in warning for warning in fit.calibration.warnings) == 1
    assert text.count(slower) == 1
    again = replace(fit.calibration, warnings=())  # the certificate reads the number, not the sentence
    again.save("array.json")
    assert issue(REVIEWED, "array.json", "again.xml") == 0
    assert slower in Path("again.xml").read_text(encoding="utf-8")


def test_a_certificate_of_a_board_says_what_its_size_rests_on(issue):
    board = il.simulate_imus(elements=2, attitudes=3, duration="10 s", rate="50 Hz")
    record = il.calibrate_imus(board, gravity=9.80665).calibration
    assert record.sections["size_from"] == "gyro scale"
    replace(record, sensor={"serial": "B1"}).save("board.json")
    assert issue(REVIEWED, "board.json") == 0
    text = Path("cert.xml").read_text(encoding="utf-8")
    assert "the mean scale factor of all gyroscopes, rest on the nominal value of that mean and its tolerance" in text
    assert "Held near their nominal values, which the recording does not tell: size of the board" in text


@pytest.mark.parametrize("name", ["tumble", "thermal_gyro", "centrifuge", "noise"])
def test_ptbs_schematron_finds_no_error(issue, name):
    schematron = pytest.importorskip("dcclib.validation.schematron", reason="dcclib (250 MB) has PTB's Schematron")
    record = il.load(WRITTEN / f"{name}.json")
    replace(record, sensor={**record.sensor, "serial": "SN-1"}).save("unit.json")
    assert issue(REVIEWED, "unit.json") == 0
    result = schematron.SchematronValidator.for_dcc().validate_file("cert.xml")
    assert result.failed_assertions == []
    assert [report.text for report in result.successful_reports if report.role == "error"] == []


# Number, unit, and structure: each of them changed is seen.


def read_back(root):
    """All numbers and names of a certificate: name to value, U, k and p; standard uncertainties; covariances."""
    single = {}
    for each in root.iterfind(".//dcc:quantity[@refType='basic_calibrationValue']", NAMES):
        label, value = _text(each, "si:real/si:label"), float(_text(each, "si:real/si:value"))
        assert label == _text(each, "dcc:name/dcc:content")
        spread = [
            float(_text(each, f".//si:{key}")) for key in ("valueExpandedMU", "coverageFactor", "coverageProbability")
        ]
        single[label] = [value, *spread]
    together = root.find(".//si:realListXMLList", NAMES)
    listed = [_text(together, "si:labelXMLList").split()]
    listed += [
        [float(x) for x in _text(together, path).split()]
        for path in ("si:valueXMLList", ".//si:valueStandardMUXMLList")
    ]
    columns = together.iterfind(".//si:columnXMLList", NAMES)
    matrix = [[float(entry.text) for entry in column.iterfind(".//si:valueXMLList", NAMES)] for column in columns]
    keys = ("value", "valueExpandedMU", "coverageFactor")
    conditions = [
        [float(found.text) for key in keys if (found := each.find(f".//si:{key}", NAMES)) is not None]
        for each in root.iterfind(".//dcc:influenceCondition", NAMES)
    ]
    return single, listed, matrix, conditions


def expected_of(made):
    """The same from the record, and the conditions."""
    results = {result.name: result for result in made.results}
    single = {
        name: [result.value, result.expanded_uncertainty, result.coverage_factor, result.probability]
        for name, result in results.items()
    }
    names = list(made.record.covariance.names)
    listed = [names, *([getattr(results[n], key) for n in names] for key in ("value", "standard_uncertainty"))]
    conditions = [
        [each.value, *([each.expanded_uncertainty, each.coverage_factor] if each.expanded_uncertainty else [])]
        for _, each in made.conditions("", "")
    ]
    return single, listed, [list(row) for row in made.record.covariance.matrix], conditions


def random_record(rng):
    """A record of six parameters with values of any size, two of which have a covariance."""
    sizes = 10 ** rng.uniform([-300] * 6 + [-140] * 6, [100] * 12)
    values, u = (sizes[:6] * rng.choice([-1, 1], 6)).tolist(), sizes[6:].tolist()
    units = ("m/s^2", "m/s^2/(m/s^2)", "rad", "1/(m/s^2)", "g/(m/s^2)", "count/(m/s^2)")
    parameters = {f"p_{n}": Parameter(*each) for n, each in enumerate(zip(values, u, units, strict=True))}
    shared = float(rng.uniform(-1, 1)) * u[0] * u[1]
    covariance = Covariance(("p_0", "p_1"), ((u[0] ** 2, shared), (shared, u[1] ** 2)))
    return Calibration("tumble", parameters, covariance, {}, {}, sensor={"serial": "SN-1"})


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory):
    path = tmp_path_factory.mktemp("lab") / "lab.toml"
    path.write_text(LAB, encoding="utf-8")
    return load_laboratory(str(path))


def test_numbers_of_any_size_come_back_bit_for_bit(laboratory):
    """4,800 of 200 certificates: values, U, k and p, values and u again, covariances."""
    rng = np.random.default_rng(7)
    for _ in range(150):
        made = make_certificate(random_record(rng), "0" * 64, laboratory)
        assert read_back(ElementTree.fromstring(dcc_xml(made))) == expected_of(made)


CHANGED = {
    "value": (r"(?s)(basic_calibrationValue.*?<si:value>-?\d)", r"\g<1>1"),
    "condition": (r"(<si:value>-?\d)", r"\g<1>1"),
    "expanded uncertainty": (r"(<si:valueExpandedMU>\d)", r"\g<1>1"),
    "standard uncertainty": (r"(<si:valueStandardMUXMLList>\d)", r"\g<1>1"),
    "covariance": (r"(<si:covarianceXMLList>\s*<si:valueXMLList>\d)", r"\g<1>1"),
    "coverage factor": (r"<si:coverageFactor>\d", "<si:coverageFactor>9"),
    "exponent of k": (r"<si:coverageFactor>[\d.]+", "<si:coverageFactor>2e0"),
    "probability": (r"<si:coverageProbability>0", "<si:coverageProbability>1"),
    "no uncertainty": (
        r"(?s)(basic_calibrationValue.*?)<si:measurementUncertaintyUnivariate>.*?</si:measurementUncertaintyUnivariate>",
        r"\g<1>",
    ),
    "unit": (r"(?<=<si:unit>)\\metre\\second", r"\\meter\\second"),
    "reference": (r'refId="parameter_1 ', 'refId="parameter_99 '),
    "same id twice": ('id="parameter_2"', 'id="parameter_1"'),
    "name": (r"<si:label>bias_x", "<si:label>bias_y"),
    "country": (r"(<dcc:countryCode>)DE", r"\g<1>Germany"),
    "day": (r"(<dcc:issueDate>\d{4})-\d\d", r"\g<1>-13"),
    "number": (r"<dcc:uniqueIdentifier>.*?</dcc:uniqueIdentifier>", ""),
}


def test_a_mean_temperature_has_no_digits_that_nobody_knows(sound, laboratory):
    record = il.load(sound / "sound.json")
    record = replace(record, model={**record.model, "temperature": {"value": 23.9999428, "unit": "degC"}})
    conditions = dict(make_certificate(record, "0" * 64, laboratory).conditions("g", "T"))
    assert (conditions["T"].value, conditions["T"].unit) == (24.0, "degC")


@pytest.fixture(scope="module")
def sound_xml(sound, laboratory):
    made = make_certificate(il.load(sound / "sound.json"), "0" * 64, laboratory)
    return made, dcc_xml(made).decode()


@pytest.mark.filterwarnings("ignore")  # of PTB's parser, on its own steps
@pytest.mark.parametrize("change", [None, *CHANGED])
def test_a_changed_certificate_is_seen(change, sound_xml, schemas, tmp_path):
    """By the schema, by PTB's parser of units, or by what the record says."""
    parser = pytest.importorskip("dsi_unit", reason="dsiunits checks units")
    made, text = sound_xml
    if change is not None:
        text, count = re.subn(*CHANGED[change], text, count=1)
        assert count == 1
    (tmp_path / "cert.xml").write_text(text, encoding="utf-8")
    root = ElementTree.fromstring(text)
    wrong = schemas(tmp_path / "cert.xml")
    units = {
        unit
        for key in ("unit", "unitXMLList")
        for each in root.iterfind(f".//si:{key}", NAMES)
        for unit in each.text.split()
    }
    wrong += [unit for unit in sorted(units) if not parser.DsiUnit(unit).valid]
    try:
        wrong += ["numbers"] * (read_back(root) != expected_of(made))
    except (AssertionError, AttributeError):
        wrong.append("something is missing")
    assert bool(wrong) == (change is not None)


@pytest.mark.parametrize(
    ("unit", "defined"), [("count", "one step of the item's digital output"), ("g", "9.80665 m/s^2")]
)
def test_outputs_that_are_no_si_units_are_defined(laboratory, schemas, tmp_path, unit, defined):
    record = random_record(np.random.default_rng(1))
    kept = {name: each for name, each in record.parameters.items() if each.unit == f"{unit}/(m/s^2)"}
    record = replace(record, parameters=kept, covariance=Covariance((), ()))
    (tmp_path / "cert.xml").write_bytes(dcc_xml(make_certificate(record, "0" * 64, laboratory)))
    assert schemas(tmp_path / "cert.xml") == []
    (quantity,) = _single(tmp_path / "cert.xml")
    assert _text(quantity, "si:real/si:unit") == r"\metre\tothe{-1}\second\tothe{2}"
    assert _text(quantity, ".//dcc:nonSIUnit") == f"{unit}/(m/s^2)"
    assert defined in _text(quantity, ".//dcc:nonSIDefinition")


def _single(path):
    """The quantities of single parameters."""
    return ElementTree.parse(path).findall(".//dcc:quantity[@refType='basic_calibrationValue']", NAMES)


def _text(element, path):
    return element.find(path, NAMES).text


def test_every_number_comes_back_bit_for_bit(issue, sound):
    assert issue() == 0
    record = json.loads((sound / "sound.json").read_text(encoding="utf-8"))
    factor, parameters = record["fit"]["coverage_factor_95"], record["parameters"]
    assert [_text(each, "si:real/si:label") for each in _single("cert.xml")] == [*parameters]
    for each, parameter in zip(_single("cert.xml"), parameters.values(), strict=True):
        assert float(_text(each, "si:real/si:value")) == parameter["value"]
        if "interval_95" in parameter:
            ends = [float(_text(each, f".//si:interval{end}")) for end in ("Min", "Max")]
            assert ends == parameter["interval_95"]
            assert float(_text(each, ".//si:valueStandardMU")) == parameter["standard_uncertainty"]
        else:
            assert float(_text(each, ".//si:coverageFactor")) == factor
            assert float(_text(each, ".//si:valueExpandedMU")) == factor * parameter["standard_uncertainty"]
    together = ElementTree.parse("cert.xml").find(".//si:realListXMLList", NAMES)
    assert _text(together, "si:labelXMLList").split() == record["covariance"]["names"]
    known = [parameters[name]["standard_uncertainty"] for name in record["covariance"]["names"]]
    assert [float(u) for u in _text(together, ".//si:valueStandardMUXMLList").split()] == known
    columns = together.findall(".//si:columnXMLList", NAMES)
    matrix = [[float(entry.text) for entry in column.findall(".//si:valueXMLList", NAMES)] for column in columns]
    assert matrix == record["covariance"]["matrix"]
    units = [entry.text for entry in together.findall(".//si:covarianceMatrixXMLList//si:unitXMLList", NAMES)]
    assert units[0] == r"\metre\tothe{2}\second\tothe{-4}"


def test_the_same_input_gives_the_same_bytes_without_a_clock(issue, sound):
    assert issue() == 0
    assert issue(output="again.xml") == 0
    text = Path("cert.xml").read_bytes()
    assert text == Path("again.xml").read_bytes()
    sha256 = json.loads((sound / "sound.json").read_text(encoding="utf-8"))["content_sha256"]
    assert f"sha256:{sha256}" in text.decode()
    assert "Example Drones &lt;b&gt;Ltd&lt;/b&gt; &amp; S\u00f6hne" in text.decode()


def test_parameters_without_uncertainty_are_counted(issue):
    assert issue(REVIEWED, WRITTEN / "warmup.json") == 0
    assert "7 values without uncertainty are in the record" in Path("cert.xml").read_text(encoding="utf-8")


REFUSED = {
    "nobody signs": (LAB.replace("signs = true", "signs = false"), "persons: nobody signs"),
    "unknown key": (LAB.replace("role =", "rank ="), "persons 1: unknown key 'rank'; known keys: name role signs"),
    "missing": (LAB.replace('condition = "as received"', ""), "item: no condition; expected a text"),
    "empty": (LAB.replace('"as received"', '""'), "item.condition: expected a text that is not empty"),
    "space": (LAB.replace('"as received"', '" as received"'), "item.condition: expected a text that is not empty"),
    "bell": (LAB.replace("as received", r"as\u0007received"), "item.condition: a control or bidirectional character"),
    "word": (
        LAB.replace('"laboratory"', '"lab"'),
        "certificate.location: expected customer or customerBranch or laboratory or laboratoryBranch or other, "
        "found 'lab'",
    ),
    "day": (
        LAB.replace("issued = ", "issued = 1 # "),
        "certificate.issued: expected a day such as 2026-11-24, found 1",
    ),
    "one day": (
        LAB.replace("[2026-11-24, 2026-11-24]", "2026-11-24"),
        "performed: expected the first and the last day, such as [2026-11-24, 2026-11-25], found 2026-11-24",
    ),
    "country": (LAB.replace('"DE" }\n[customer]', '"Germany" }\n[customer]'), "laboratory.address.country: expected"),
    "no day": (LAB.replace("2026-11-20", '"last week"'), "certificate.received: "),
    "issued before": (LAB.replace("issued = 2026-11-27", "issued = 2026-11-23"), "out of order"),
    "received after": (LAB.replace("received = 2026-11-20", "received = 2026-11-25"), "received 2026-11-25, after"),
    "one day of two": (
        LAB.replace("[2026-11-24, 2026-11-24]", "[2026-11-24]"),
        "performed: expected the first and the last day, such as [2026-11-24, 2026-11-25], found [2026-11-24]",
    ),
    "infinite": (LAB.replace("23.0", "inf"), "conditions 1: value: expected a number, found inf"),
    "long unit": (
        LAB.replace('"degC"', f'"{"(" * 3000}m{")" * 3000}"'),
        "conditions 1: unit: expected a unit of at most 64 characters",
    ),
    "own number": (
        LAB.replace("location =", 'replaces = "EX-2026-0042"\nreason = "typing"\nlocation ='),
        "certificate: replaces 'EX-2026-0042' is its own number",
    ),
    "next before": (
        LAB.replace("location =", 'recalibration = { date = 2026-11-27, agreed = "offer" }\nlocation ='),
        "certificate.recalibration: 2026-11-27; expected a day after",
    ),
    "unit": (LAB.replace('"degC"', '"furlong"'), "unit furlong: the D-SI"),
    "serial": (LAB.replace("condition =", 'serial = "SN-1"\ncondition ='), "item.serial 'SN-1': the record says"),
    "gravity": (LAB + STANDARD.replace("1e-6", "1e-3"), "fit again with --gravity 9.81362+-0.001"),
    "gravity's unit": (LAB + STANDARD.replace('"m/s^2"', '"deg"'), "expected a unit of acceleration"),
    "no gravity": (LAB + STANDARD.replace("standard_unc", "#"), "expected standard_uncertainty of gravity"),
    "rule": (
        LAB + '[conformity]\nrule = "guard"\nagreed = "a"\nspecification = "b"\n',
        "conformity.rule: expected bands or guarded or simple, found 'guard'",
    ),
    "language": (
        re.sub(r"(?m)^(language = .*\n)?location =", 'language = "fr"\nlocation =', LAB),
        "expected de or en, found 'fr'",
    ),
    "text for a number": (
        LAB.replace("value = 23.0", 'value = "23"'),
        "conditions 1: value: expected a number, found '23'",
    ),
    "not TOML": ("[certificate", "the laboratory file is not TOML"),
}


@pytest.mark.parametrize(("lab", "expected"), REFUSED.values(), ids=REFUSED)
def test_what_is_wrong_is_refused_in_one_line_and_nothing_is_written(issue, capsys, lab, expected):
    assert issue(lab) == 2
    message = capsys.readouterr().err
    assert expected in message
    assert message.count("\n") == 1
    assert not Path("cert.xml").exists()


def _places(table, place=()):
    """The keys and indices of every entry in a table."""
    for key, entry in table.items() if isinstance(table, dict) else enumerate(table):
        yield (*place, key)
        if isinstance(entry, dict | list):
            yield from _places(entry, (*place, key))


@pytest.mark.parametrize("wrong", ["removed", {"a": 1}, [[]], True, -1, math.nan, "1\t2 "], ids=repr)
def test_every_mistake_is_refused_in_imulabs_words(monkeypatch, tmp_path, wrong):
    """The place, counted from 1, what is expected, and what is found; nothing of the parser's."""
    path = tmp_path / "lab.toml"
    path.touch()
    template = tomllib.loads(TEMPLATE)
    for *outer, last in _places(template):
        table = deepcopy(template)
        inner = reduce(getitem, outer, table)
        if wrong == "removed":
            del inner[last]
        else:
            inner[last] = wrong
        monkeypatch.setattr(laboratory_file, "load_toml", lambda *_, table=table: table)
        with suppress(il.ImulabError):
            load_laboratory(str(path))
            continue  # a text may stand where another did
        with pytest.raises(il.ImulabError) as refusal:
            load_laboratory(str(path))
        message = str(refusal.value)
        assert re.match(rf"{path}: .*(expected |unknown key |nobody signs|out of order|a control)", message)
        assert not re.search(r"`|\[\d\]|array|object|enum", message)


@pytest.mark.parametrize(
    ("record", "expected"),
    [
        (WRITTEN / "tumble.json", "the record's verdict is look; expected certificate.reviewed"),
        (WRITTEN / "noise.json", "the record names no serial number"),
        (WRITTEN / "nobody.json", "No such file"),
    ],
    ids=["look", "no serial", "missing"],
)
def test_records_that_cannot_be_certified_are_refused(issue, capsys, record, expected):
    assert issue(LAB, record) == 2
    assert expected.lower() in capsys.readouterr().err.lower()
    assert not Path("cert.xml").exists()


@pytest.mark.parametrize(
    ("measured", "status"),
    [("2026-11-24", 0), ("2026-11-23", 2), ("2026-11-23T23:10:05Z", 0), ("2026-11-25T11:00:00Z", 0), ("2027-01-01", 2)],
)
def test_days_of_work_are_those_of_the_recordings(issue, capsys, sound, measured, status):
    record = il.load(sound / "sound.json")
    replace(record, sources=(Source("t.csv", "0" * 64, measured),)).save("dated.json")
    assert issue(record="dated.json") == status
    assert (f"t.csv says that it was measured {measured}" in capsys.readouterr().err) == bool(status)


def test_a_laboratory_file_that_is_not_there_is_refused_with_how_to_write_one(sound, capsys):
    assert main(["certificate", str(sound / "sound.json"), "--lab", "no.toml", "-o", "cert.xml"]) == 2
    expected = "no.toml: no such laboratory file; imulab certificate --template -o LAB.toml writes one"
    assert capsys.readouterr().err == f"imulab: {expected}\n"


@pytest.mark.parametrize("source", ["manifest, taken as exact", "the test's manifest"])
def test_a_record_that_takes_gravity_as_exact_is_sent_to_no_option_that_it_lacks(issue, capsys, source):
    record = il.load(WRITTEN / "centrifuge.json")
    gravity = {**record.model["gravity"], "from": source}
    replace(record, model={**record.model, "gravity": gravity}).save("centrifuge.json")
    assert issue(REVIEWED + STANDARD, "centrifuge.json") == 2
    assert "a centrifuge record takes gravity as exact; leave this equipment out" in capsys.readouterr().err


def test_an_altered_or_bad_record_is_refused(issue, capsys, sound):
    text = (sound / "sound.json").read_text(encoding="utf-8")
    Path("altered.json").write_text(re.sub(r'"value": (-?)0\.', r'"value": \g<1>1.', text, count=1), encoding="utf-8")
    assert issue(LAB, "altered.json") == 2
    assert "altered" in capsys.readouterr().err
    replace(il.load(sound / "sound.json"), verdict=Verdict("bad", ("no gravity",))).save("bad.json")
    assert issue(REVIEWED, "bad.json") == 2
    assert "verdict is bad: no gravity" in capsys.readouterr().err


@pytest.mark.parametrize(("key", "text"), [("serial", " "), ("model", "triad ")])
def test_names_that_the_schema_refuses_are_refused(issue, capsys, sound, key, text):
    record = il.load(sound / "sound.json")
    replace(record, sensor={**record.sensor, key: text}).save("unit.json")
    assert issue(record="unit.json") == 2
    assert f"{key} {text!r}: a space at an end" in capsys.readouterr().err
    assert not Path("cert.xml").exists()


def test_an_output_that_is_an_input_or_no_certificate_is_refused(issue, capsys):
    for output, expected in (("lab.toml", "would overwrite"), ("cert.html", "expected a name that ends with")):
        Path("lab.toml").touch()
        assert issue(output=output) == 2
        assert expected in capsys.readouterr().err


@pytest.mark.parametrize(
    ("unit", "expected"),
    [
        ("m/s^2", r"\metre\second\tothe{-2}"),
        ("m/s^2/(m/s^2)", r"\one"),
        ("m/s^2/(m/s^2)/K", r"\kelvin\tothe{-1}"),
        ("1/(m/s^2)", r"\metre\tothe{-1}\second\tothe{2}"),
        ("rad/s/sqrt(Hz)", r"\radian\second\tothe{-1}\hertz\tothe{-0.5}"),
        ("deg/s/(rad/s)", r"\degree\radian\tothe{-1}"),
        ("uT/T", r"\micro\tesla\tesla\tothe{-1}"),
        ("count/(m/s^2)", r"\metre\tothe{-1}\second\tothe{2}"),
        ("1", r"\one"),
    ],
)
def test_units_are_products_of_powers(unit, expected):
    assert dsi_unit(unit)[0] == expected


@pytest.mark.parametrize("unit", ["", "m/", "furlong", "m^", "(m", "m)", "2 m", "m s"])
def test_units_without_a_name_are_refused(unit):
    with pytest.raises(UnitError, match="the D-SI"):
        dsi_unit(unit)


@pytest.mark.filterwarnings("ignore")  # of the parser, on its own steps
def test_units_of_written_records_are_known_to_ptbs_parser():
    parser = pytest.importorskip("dsi_unit", reason="dsiunits checks units")
    units = {
        parameter["unit"]
        for path in WRITTEN.glob("*.json")
        for parameter in json.loads(path.read_text(encoding="utf-8")).get("parameters", {}).values()
    }
    assert len(units) > 10
    assert [unit for unit in units if not parser.DsiUnit(dsi_unit(unit)[0]).valid] == []


def test_the_region_of_all_parameters_holds_95_percent(sound, tmp_path):
    (tmp_path / "lab.toml").write_text(LAB, encoding="utf-8")
    made = make_certificate(il.load(sound / "sound.json"), "0" * 64, load_laboratory(str(tmp_path / "lab.toml")))
    root = ElementTree.fromstring(dcc_xml(made))
    factor = float(_text(root, ".//si:coverageFactorXMLList"))
    assert math.isclose(chi2.cdf(factor**2, len(made.record.covariance.names)), 0.95, rel_tol=1e-12)


# Conformity.


RULE = """
[conformity]
rule = "bands"
agreed = "offer 2026-118"
specification = "data sheet DS-0815, table 2"
"""
INFINITE = math.inf


@pytest.mark.parametrize(
    ("y", "u", "lower", "upper", "probability"),
    [
        (-5.47, 0.05, -INFINITE, -5.40, 0.919243),
        (509.7, 8.6, 490, INFINITE, 0.989010),
        (13.6, 1.8, 12.5, 16.3, 0.662630),
        (8, 1, -INFINITE, 10, 0.977250),
    ],
)
def test_probabilities_are_those_of_the_guide_to_conformity(y, u, lower, upper, probability):
    """JCGM 106:2012, examples of clause 7: 0.92, 0.99, 0.66."""
    assert decide(y, u, 2.0, Limits(lower, upper), "bands").probability == pytest.approx(probability, abs=5e-7)


@pytest.mark.parametrize(
    ("y", "bands", "guarded", "simple"),
    [
        (8.0, "pass", "pass", "pass"),
        (8.01, "conditionalPass", "fail", "pass"),
        (10.0, "conditionalPass", "fail", "pass"),
        (10.01, "conditionalFail", "fail", "fail"),
        (12.01, "fail", "fail", "fail"),
    ],
)
def test_decisions_by_each_rule(y, bands, guarded, simple):
    for rule, state in (("bands", bands), ("guarded", guarded), ("simple", simple)):
        assert decide(y, 1.0, 2.0, Limits(-INFINITE, 10.0), rule).state == state


@pytest.mark.parametrize("freedom", [None, 9.0])
def test_the_probability_of_all_is_that_of_scipy(freedom):
    rng = np.random.default_rng(5)
    root = rng.standard_normal((7, 7))
    covariance, mean = root @ root.T, rng.standard_normal(7)
    u = np.sqrt(np.diag(covariance))
    low, high = mean - rng.uniform(1, 3, 7) * u, mean + rng.uniform(1, 3, 7) * u
    low[2] = -INFINITE
    limits = [Limits(*ends) for ends in zip(low.tolist(), high.tolist(), strict=True)]
    found = probability_of_all(mean.tolist(), covariance, limits, freedom)
    if freedom is None:
        expected = multivariate_normal.cdf(high, mean=mean, cov=covariance, lower_limit=low)
    else:
        expected = multivariate_t.cdf(high, loc=mean, shape=covariance, df=freedom, lower_limit=low)
    assert found == pytest.approx(expected, abs=1.5e-3)
    each = [decide(m, s, 2.0, ends, "simple", freedom).probability for m, s, ends in zip(mean, u, limits, strict=True)]
    assert 1 - sum(1 - p for p in each) <= found <= min(each) + 5e-4


def test_decisions_stand_in_a_valid_certificate_and_are_shown(issue, schemas, sound, capsys):
    values = {n: p["value"] for n, p in json.loads((sound / "sound.json").read_text())["parameters"].items()}
    limits = (
        '[tumble]\n"bias_*" = { lower = -0.5, upper = 0.5, unit = "m/s^2" }\n'
        f'scale_factor_x = {{ upper = {values["scale_factor_x"] - 1e-9!r}, unit = "m/s^2/(m/s^2)" }}\n'
        "[noise]\nnothing = 1\n"  # of another procedure: passed over
    )
    assert issue(LAB + STANDARD + RULE, limits=limits) == 0
    assert schemas("cert.xml") == []
    states = {
        _text(each, "dcc:name/dcc:content"): each.findall(".//dcc:conformity", NAMES) for each in _single("cert.xml")
    }
    assert [state.text for state in states["bias_x"]] == ["pass"]
    assert [state.text for state in states["scale_factor_x"]] == ["conditionalFail"]
    assert states["misalignment_yx"] == []
    tree = ElementTree.parse("cert.xml")
    assert tree.findall(".//dcc:statement/dcc:conformity", NAMES)[0].text == "conditionalFail"
    upper = tree.findall(".//dcc:quantity[@refType='basic_toleranceLimitUpper']//si:value", NAMES)
    assert float(upper[-1].text) == values["scale_factor_x"] - 1e-9
    capsys.readouterr()
    assert main(["show", "cert.xml"]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"^conformity: conditionalFail, Conformity with .* bands .*$", shown, re.M)
    assert re.search(r"^bias_x .* -0\.5 … 0\.5 +pass$", shown, re.M)
    assert re.search(r"^scale_factor_x .* … \S+ +conditionalFail$", shown, re.M)
    assert re.search(r"^misalignment_yx .* radian +– +–$", shown, re.M)


@pytest.mark.parametrize(
    ("rule", "limits", "message"),
    [
        ("", '[tumble]\nbias_x = { upper = 1, unit = "mg" }\n', "limits need a rule that the customer agreed to"),
        (RULE, '[tumble]\nbias_x = { upper = 1, unit = "deg" }\n', "limits.toml: tumble: bias_x: unit 'deg': expected"),
        (RULE, '[tumble]\nbais_x = { upper = 1, unit = "mg" }\n', "no parameter 'bais_x'"),
        (RULE, "[noise]\nwhite = 1\n", "limits.toml: no limits of a parameter of this record"),
        (RULE.replace("bands", "kind"), "[tumble]\n", "conformity.rule: "),
    ],
)
def test_limits_that_cannot_be_decided_by_are_refused(issue, capsys, rule, limits, message):
    assert issue(LAB + STANDARD + rule, limits=limits) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not Path("cert.xml").exists()


def test_the_template_is_that_of_the_guide_and_makes_a_valid_certificate(issue, schemas, capsys):
    assert main(["certificate", "--template", "-o", "t.pdf"]) == 2
    assert capsys.readouterr().err == "imulab: t.pdf: the template is TOML; expected a name that ends in .toml\n"
    assert main(["certificate", "--template"]) == 0
    template = capsys.readouterr().out
    guide = Path(__file__).resolve().parents[1] / "docs" / "certificate.md"
    assert f"```toml\n{template}```" in guide.read_text(encoding="utf-8")
    assert main(["certificate", "--template", "-o", "start.toml"]) == 0
    assert Path("start.toml").read_text(encoding="utf-8") == template
    assert issue(template) == 0
    assert schemas("cert.xml") == []
    agreed = re.sub("(?m)^# ((.conformity|rule|agreed|specification).*)$", r"\1", template)
    assert issue(agreed, output="decided.xml", limits='[tumble]\nbias_x = { upper = 50, unit = "mg" }\n') == 0
    assert schemas("decided.xml") == []


def test_what_is_missing_on_the_command_line_is_said(capsys):
    assert main(["certificate", "r.json", "-o", "c.xml"]) == 2
    assert capsys.readouterr().err == ("imulab: expected RECORD, --lab LAB.toml and -o CERT.pdf, or --template alone\n")


def test_show_reads_a_certificate(issue, capsys):
    assert issue() == 0
    capsys.readouterr()
    assert main(["show", "cert.xml"]) == 0
    shown = capsys.readouterr().out
    assert "Digital Calibration Certificate 3.3.0" in shown
    value, u = re.search(r"^bias_x +(-?\d\.\d+) +(0\.0*[1-9]\d) +\d\S+ +metre second\^-2$", shown, re.M).groups()
    assert len(value.lstrip("-")) == len(u)  # both end at the same place
    assert "signature: none" in shown
    assert main(["tumble", "fit", "cert.xml"]) == 2
    assert "expected a recording, found an XML file (imulab show reads certificates)" in capsys.readouterr().err
    text = Path("cert.xml").read_text(encoding="utf-8")
    Path("bare.xml").write_text("\ufeff\n" + text.partition("?>")[2], encoding="utf-8")
    capsys.readouterr()
    assert main(["show", "bare.xml"]) == 0
    assert capsys.readouterr().out == shown.replace("cert.xml", "bare.xml")
    Path("empty.pdf").write_bytes(b"%PDF-1.7\n")
    assert main(["show", "empty.pdf"]) == 2
    assert "empty.pdf: a PDF without a Digital Calibration Certificate" in capsys.readouterr().err
    text = Path("cert.xml").read_text(encoding="utf-8")
    unstated = text.replace("<si:value>", "<si:value>n", 3)
    Path("unstated.xml").write_text(unstated, encoding="utf-8")
    assert main(["show", "unstated.xml"]) == 0
    for changed in (text[:3000], text.replace("?>", '?><!DOCTYPE a [<!ENTITY b "c">]>', 1)):
        Path("hostile.xml").write_text(changed, encoding="utf-8")
        assert main(["show", "hostile.xml"]) == 2


@pytest.mark.parametrize(("issued", "expected"), [
    ("2026-11-25", "certificate.issued 2026-11-25: before the record was made, on 2026-11-28; expected a later day"),
    ("2026-11-27", ""),  # perhaps the same day, in another time zone
    ("2026-12-01", ""),
    ("2999-01-01", "certificate.issued 2999-01-01: in the future; expected the day of issue"),
])  # fmt: skip
def test_a_day_of_issue_that_cannot_be_is_warned_of(tmp_path, issued, expected):
    lab = re.sub(r"(?m)^issued = \S+", f"issued = {issued}", LAB)
    (tmp_path / "lab.toml").write_text(lab, encoding="utf-8")
    said = day_remarks(str(tmp_path / "lab.toml"), "2026-11-28T10:00:00Z", date(2026, 12, 1))
    assert "".join(said).removeprefix(f"{tmp_path / 'lab.toml'}: ")[: len(expected)] == expected
    assert bool(said) == bool(expected)


def test_what_is_still_the_template_s_is_warned_of(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    recording = il.simulate_tumble(gravity=9.81362, attitudes=12, order=1, gyro=True)
    il.fit_tumble(recording, gravity="9.81362+-0.00002", order=1).calibration.save("a.json")
    il.fit_tumble(recording, gravity="9.81362+-0.00002", order=1, with_="gyro").calibration.save("b.json")
    text = TEMPLATE.replace("location =", 'reviewed = "seen"\nlocation =')
    Path("lab.toml").write_text(text, encoding="utf-8")
    assert main(["certificate", "a.json", "--lab", "lab.toml", "-o", "a.xml"]) == 0
    said = capsys.readouterr().err
    assert "which names nobody: certificate.number = 'EX-2026-0042', laboratory.name" in said
    assert "tumbled" not in said
    assert main(["certificate", "b.json", "--lab", "lab.toml", "-o", "b.xml"]) == 0
    said = capsys.readouterr().err
    assert "item.name = 'Accelerometer triad' and method.name = " in said
    assert "the record holds bias_x, bias_y, bias_z and " in said
    for name, other in (("EX-2026-0042", "7"), ("Example", "Real"), ("GRAV-2024-017", "G"), ("A. Real", "B. Real")):
        text = text.replace(name, other)
    Path("lab.toml").write_text(text.replace("Accelerometer triad", "IMU").replace("Multi-position t", "T"))
    assert main(["certificate", "b.json", "--lab", "lab.toml", "-o", "c.xml"]) == 0
    assert "template" not in capsys.readouterr().err
