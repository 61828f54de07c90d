"""Signatures of certificates: verified by another library's reader, broken by one digit, refused by name."""

import sys
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path

import pytest

from imulab.cli import main

signxml = pytest.importorskip("signxml", reason="signxml signs certificates")
pytest.importorskip("typst", reason="typst lays out certificates")
pypdf = pytest.importorskip("pypdf", reason="pypdf reads their PDF")

from cryptography import x509  # noqa: E402
from cryptography.hazmat.primitives import hashes, serialization  # noqa: E402
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa  # noqa: E402
from lxml import etree  # noqa: E402

DATA = Path(__file__).resolve().parent / "data"
RECORD = str(DATA / "written_by" / "0.2.0" / "tumble.json")
PEM = serialization.Encoding.PEM
YEARS = datetime(2026, 1, 1, tzinfo=UTC), datetime(2027, 1, 1, tzinfo=UTC)


def certificate_of(key, years=YEARS):
    """A certificate that the key signs for itself, PEM."""
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "Example Inertial Laboratory")])
    made = x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(key.public_key())
    made = made.serial_number(7).not_valid_before(years[0]).not_valid_after(years[1])
    return made.sign(key, None if isinstance(key, ed25519.Ed25519PrivateKey) else hashes.SHA256()).public_bytes(PEM)


def pem_of(key, passphrase=None):
    lock = serialization.NoEncryption() if passphrase is None else serialization.BestAvailableEncryption(passphrase)
    return key.private_bytes(PEM, serialization.PrivateFormat.PKCS8, lock)


@pytest.fixture(scope="module")
def keys():
    return {"rsa": rsa.generate_private_key(65537, 2048), "ec": ec.generate_private_key(ec.SECP256R1())}


@pytest.fixture
def sign(tmp_path, monkeypatch):
    """A function that certifies a record by the command with this PEM file, and returns the exit status."""
    monkeypatch.chdir(tmp_path)
    lab = (DATA / "lab.toml").read_text(encoding="utf-8")
    Path("lab.toml").write_text(lab.replace("location =", 'reviewed = "seen"\nlocation ='), encoding="utf-8")

    def run(pem, output="cert.xml"):
        Path("key.pem").write_bytes(pem)
        return main(["certificate", RECORD, "--lab", "lab.toml", "--sign", "key.pem", "-o", output])

    return run


def verified(xml, key):
    """The signed content as the verifier returns it."""
    return signxml.XMLVerifier().verify(xml, x509_cert=certificate_of(key).decode()).signed_xml


@pytest.mark.parametrize("kind", ["rsa", "ec"])
def test_a_signature_is_verified_and_changes_nothing_else(sign, keys, kind):
    key = keys[kind]
    assert sign(pem_of(key) + certificate_of(key)) == 0
    assert main(["certificate", RECORD, "--lab", "lab.toml", "-o", "plain.xml"]) == 0
    content = verified(Path("cert.xml").read_bytes(), key)
    plain = etree.parse("plain.xml").getroot()
    for one in (content, plain):  # the break before the end of the root stood before the signature
        one[-1].tail = None
    assert etree.tostring(content, method="c14n") == etree.tostring(plain, method="c14n")


def test_the_signed_xml_is_in_the_pdf_and_the_same_twice(sign, keys):
    pem = certificate_of(keys["rsa"]) + pem_of(keys["rsa"])
    assert [sign(pem, name) for name in ("cert.xml", "cert.pdf", "again.pdf")] == [0, 0, 0]
    pdf = Path("cert.pdf").read_bytes()
    assert pdf == Path("again.pdf").read_bytes()
    assert pypdf.PdfReader(BytesIO(pdf)).attachments["certificate.xml"] == [Path("cert.xml").read_bytes()]


def test_one_digit_or_another_indent_breaks_it(sign, keys):
    assert sign(pem_of(keys["ec"]) + certificate_of(keys["ec"])) == 0
    xml = Path("cert.xml").read_bytes()
    tree = etree.fromstring(xml)
    etree.indent(tree, space="    ")
    for changed in (xml.replace(b"<si:value>2", b"<si:value>3", 1), etree.tostring(tree)):
        assert changed != xml
        with pytest.raises(signxml.InvalidSignature):
            verified(changed, keys["ec"])


def test_a_signature_of_a_part_is_not_one_of_the_certificate(sign, keys, capsys):
    """A genuine certificate within another, whose signature is of it alone, and beside a signature that is no more."""
    key = keys["ec"]
    assert sign(pem_of(key) + certificate_of(key)) == 0
    assert main(["certificate", RECORD, "--lab", "lab.toml", "-o", "plain.xml"]) == 0
    genuine, signed = etree.parse("plain.xml").getroot(), etree.parse("cert.xml").getroot()
    genuine.set("Id", "part")
    other = etree.fromstring(Path("plain.xml").read_bytes().replace(b"<si:value>2", b"<si:value>3", 1))
    other.append(genuine)
    signer = signxml.XMLSigner(method=signxml.methods.enveloped, signature_algorithm="ecdsa-sha256")
    made = signer.sign(other, key=pem_of(key), cert=certificate_of(key).decode(), reference_uri="#part")
    Path("other.xml").write_bytes(etree.tostring(made, xml_declaration=True, encoding="utf-8"))
    made.insert(0, signed.find("{*}Signature"))
    Path("both.xml").write_bytes(etree.tostring(made, xml_declaration=True, encoding="utf-8"))
    assert verified(Path("other.xml").read_bytes(), key).tag == other.tag
    capsys.readouterr()
    for name in ("other.xml", "both.xml"):
        assert main(["show", name]) == 2
        assert capsys.readouterr().err.startswith(f"imulab: {name}: the signature ")
    assert main(["show", "cert.xml"]) == 0


def test_the_schema_holds(sign, keys, real_data):
    path = real_data / "dcc" / "dcc" / "v3.3.0.xsd"
    if not path.exists():
        pytest.skip("PTB's schemas are not here (IMULAB_DATA)")
    assert sign(pem_of(keys["rsa"]) + certificate_of(keys["rsa"])) == 0
    schema = etree.XMLSchema(etree.parse(path))
    schema.validate(etree.parse("cert.xml"))
    assert list(schema.error_log) == []


def test_what_cannot_sign_is_refused_and_nothing_is_written(sign, keys, capsys, monkeypatch):
    key, other = keys["ec"], certificate_of(keys["rsa"])
    before = certificate_of(key, (YEARS[0].replace(year=2024), YEARS[0]))
    new = ed25519.Ed25519PrivateKey.generate()
    for pem, said in (
        (b"", "expected one private key and the signer's certificate"),
        (pem_of(key), "expected one private key and the signer's certificate"),
        (pem_of(key) + other, "the private key is not that of the certificate, CN=Example Inertial Laboratory"),
        (pem_of(key) + before, "the certificate is valid from 2024-01-01 to 2026-01-01, not on 2026-11-27"),
        (pem_of(key, b"secret") + certificate_of(key), "the private key is locked by a pass phrase"),
        (pem_of(key).replace(b"M", b"-", 1) + certificate_of(key), "key.pem: the key or the certificate is damaged"),
        (pem_of(new) + certificate_of(new), "expected a private key of RSA or on an elliptic curve"),
    ):
        assert sign(pem) == 2
        error = capsys.readouterr().err
        assert said in error
        assert error.count("\n") == 1
        assert not Path("cert.xml").exists()
    monkeypatch.setitem(sys.modules, "signxml", None)
    assert sign(pem_of(key) + certificate_of(key)) == 2
    assert "a signature needs signxml, which is not here: pip install '.[sign]'" in capsys.readouterr().err


def test_show_says_whether_a_signature_holds(sign, keys, capsys, monkeypatch):
    assert sign(pem_of(keys["ec"]) + certificate_of(keys["ec"])) == 0
    assert main(["show", "cert.xml"]) == 0
    assert "signature: holds, nothing was changed since CN=" in capsys.readouterr().out
    signed = Path("cert.xml").read_bytes()
    Path("changed.xml").write_bytes(
        signed.replace(b"<si:value>1", b"<si:value>2", 1).replace(b"EX-2026", b"EX-2027", 1)
    )
    assert main(["show", "changed.xml"]) == 2
    assert "changed.xml: the signature does not hold" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "signxml", None)
    assert main(["show", "cert.xml"]) == 0
    assert "signature: there is one, which was not verified: pip install '.[sign]'" in capsys.readouterr().out
