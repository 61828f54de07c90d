"""A signature in the XML of a certificate: XMLDSig, enveloped, last of all, over the bytes as they are written.

Canonical XML 1.1 and SHA-256. A program that indents the file anew, or changes one digit, breaks the signature.
Source: W3C XML Signature 1.1; PTB dcc.xsd 3.3.0 has the element at the end of the root.
"""

from __future__ import annotations

import re
from datetime import date
from importlib import import_module
from pathlib import Path
from typing import Any

from imulab.errors import OptionError, ReadError, install, readable

_BLOCK = re.compile(rb"-----BEGIN ([A-Z0-9 ]+)-----.+?-----END \1-----\s*", re.DOTALL)
_CRYPTOGRAPHY = "cryptography.hazmat.primitives"


def signed(xml: bytes, pem: str, issued: date) -> bytes:
    """Return the XML with a signature.

    Parameters
    ----------
    xml
        A certificate without one.
    pem
        File of the signer's private key, RSA or on an elliptic curve, and certificate, with those of issuers after it.
    issued
        The day on which the signer's certificate must be valid.

    Raises
    ------
    ReadError
        The file cannot be read, or lacks key or certificate.
    OptionError
        signxml is not installed; key and certificate do not belong together, or the certificate is not valid that day.
    """
    try:
        signxml, etree, x509 = map(import_module, ("signxml", "lxml.etree", "cryptography.x509"))
        serialization, rsa, ec = (
            import_module(f"{_CRYPTOGRAPHY}.{name}") for name in ("serialization", "asymmetric.rsa", "asymmetric.ec")
        )
    except ImportError:
        raise OptionError(f"a signature needs signxml, which is not here: {install('sign')}") from None
    key, chain = _key_and_chain(pem, x509, serialization)
    encoding = serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo
    if key.public_key().public_bytes(*encoding) != chain[0].public_key().public_bytes(*encoding):
        raise OptionError(f"{pem}: the private key is not that of the certificate, {chain[0].subject.rfc4514_string()}")
    first, last = chain[0].not_valid_before_utc.date(), chain[0].not_valid_after_utc.date()
    if not first <= issued <= last:
        raise OptionError(f"{pem}: the certificate is valid from {first} to {last}, not on {issued}, the day of issue")
    if not isinstance(key, rsa.RSAPrivateKey | ec.EllipticCurvePrivateKey):
        raise OptionError(f"{pem}: expected a private key of RSA or on an elliptic curve")
    method = "rsa-sha256" if isinstance(key, rsa.RSAPrivateKey) else "ecdsa-sha256"
    signer = signxml.XMLSigner(signature_algorithm=method)
    root = signer.sign(etree.fromstring(xml), key=key, cert=chain)
    text: bytes = etree.tostring(root, xml_declaration=True, encoding="UTF-8")
    return text + b"\n"


def _key_and_chain(pem: str, x509: Any, serialization: Any) -> tuple[Any, list[Any]]:
    """Return the private key and the certificates of a file."""
    with readable(pem):
        blocks = [(match[1], match[0]) for match in _BLOCK.finditer(Path(pem).read_bytes())]
    keys = [block for kind, block in blocks if kind.endswith(b"PRIVATE KEY")]
    certificates = [block for kind, block in blocks if kind == b"CERTIFICATE"]
    if len(keys) != 1 or not certificates:
        raise ReadError(f"{pem}: expected one private key and the signer's certificate, both PEM, in one file")
    try:
        return serialization.load_pem_private_key(keys[0], None), [
            x509.load_pem_x509_certificate(c) for c in certificates
        ]
    except TypeError:
        raise ReadError(f"{pem}: the private key is locked by a pass phrase; expected one without") from None
    except Exception as error:  # of the library's own kinds
        raise ReadError(f"{pem}: the key or the certificate is damaged: {error}") from None
