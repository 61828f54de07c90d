"""``python -m imulab``: the command line."""

from imulab.cli import run

run()
