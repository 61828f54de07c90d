"""The version, alone so that everything may import it."""

VERSION = "0.2.0"
