"""The compiled functions of scipy, loaded without their package, beside the package as everybody else has it."""

import subprocess
import sys

NAMES = ["chdtrc", "chdtri", "fdtrc", "ndtr", "ndtri", "stdtr", "stdtrit", "sici"]


def _printed(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


def test_the_package_does_not_run_until_something_else_of_it_is_asked_for():
    begin = "import sys; from imulab.estimation import special; "
    wrapped = "'scipy.special._support_alternative_backends' in sys.modules"
    code = (
        f"{begin} print({wrapped}); from scipy.special import gammaln; print(round(float(gammaln(5.0)), 12), {wrapped})"
    )
    assert _printed(code) == "False\n3.178053830348 True\n"  # ln 24


def test_the_package_is_whole_afterwards_and_has_the_same_functions():
    code = (
        "from imulab.estimation import special\n"
        "import scipy.special, scipy.optimize, scipy.stats\n"
        f"print([getattr(special, name) is getattr(scipy.special, name) for name in {NAMES}])\n"
        "try:\n"
        "    with scipy.special.errstate(all='raise'):\n"
        "        special.ndtri(-1.0)\n"
        "except scipy.special.SpecialFunctionError:\n"
        "    print('raised')\n"
        "print(scipy.optimize.brentq(lambda x: x - 1, 0, 3), hasattr(scipy.special, 'absent'))\n"
    )
    assert _printed(code) == f"{[True] * len(NAMES)}\nraised\n1.0 False\n"


def test_a_package_that_is_there_already_is_used():
    code = (
        "import scipy.special as package; from imulab.estimation import special; "
        f"print([getattr(special, name) is getattr(package, name) for name in {NAMES}])"
    )
    assert _printed(code) == f"{[True] * len(NAMES)}\n"
