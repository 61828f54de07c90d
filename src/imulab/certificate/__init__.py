"""The certificate that a laboratory hands out: a record and LAB.toml as a Digital Calibration Certificate."""
