"""Noise at rest: a model of every sensor's noise, and the numbers that filters need. Here are the options' values."""

from __future__ import annotations

from imulab.errors import OptionError, listed, meant
from imulab.estimation.decisions import NOISE_MODEL_REJECTED

HORIZON = 10.0
"""s that a filter predicts without aiding."""
NO_COVARIATE = "no"
COVARIATES = ("time", "temperature")
SAY_STEPS = "say"
STEPS = (SAY_STEPS, "remove")
LETTERS = {
    "N": "white noise",
    "B": "1/f noise",
    "K": "random walk",
    "G": "Gauss-Markov noise",
    "Q": "quantisation of the angle",
}


def rejected(probability: float, columns: int) -> bool:
    """Return whether a test of fit rejects a model: a good model of one of so many columns in 1 % of records."""
    return probability < NOISE_MODEL_REJECTED.level / columns


def check_terms(text: str, called: str = "terms") -> str:
    """Return the letters of a model, or ``auto``, after a check.

    Raises
    ------
    OptionError
        The text is no model.
    """
    if text == "auto":
        return text
    if "N" not in text or any(
        letter not in LETTERS or text.count(letter) > (2 if letter == "G" else 1) for letter in text
    ):
        known = ", ".join(f"{letter} {name}" for letter, name in LETTERS.items())
        raise OptionError(
            f"{called} {text!r}: expected auto, or N and any of the others, each once, G up to twice: {known}"
            f"{meant(['auto'], text)}"
        )
    return text


def spelled(letters: str) -> str:
    """Return a model in words, and its letters: ``white noise + random walk (NK)``."""
    return f"{' + '.join(LETTERS[letter] for letter in letters)} ({letters})"


def check_options(
    terms: str, horizon: float | None, band: float | None, regress: str | None, steps: str | None, label: str = "{}"
) -> None:
    """Check the options before any data are read; `label` makes the name of an option in messages.

    Raises
    ------
    OptionError
        An option has a value that cannot be used.
    """
    check_terms(terms, label.format("terms"))
    if horizon is not None and not 0 < horizon < 1e6:
        raise OptionError(f"{label.format('horizon')} {horizon:g} s: expected more than 0")
    if band is not None and not 0 < band < 1e9:
        raise OptionError(f"{label.format('band')} {band:g} Hz: expected more than 0")
    if regress not in (None, NO_COVARIATE, *COVARIATES):
        raise OptionError(f"{label.format('regress')} {regress!r}: expected one of {listed(COVARIATES, str(regress))}")
    if steps is not None and steps not in STEPS:
        raise OptionError(f"{label.format('steps')} {steps!r}: expected one of {listed(STEPS, steps)}")
