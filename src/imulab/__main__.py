"""``python -m imulab``: the command line."""

from imulab.cli import run

if __name__ == "__main__":  # processes that are started from this one import it again
    run()
