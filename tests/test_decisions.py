"""Levels of tests stand in one module, are all in use, and add up to what is stated here for each procedure."""

import ast
import math
import re

import pytest
from scipy.stats import chi2, norm

from imulab.estimation import decisions
from imulab.estimation.decisions import MOST_FALSE_ALARMS, NINE_AXES, all_decisions, false_alarms
from test_imports import source_modules

LEVEL = re.compile(r"(CHANCE|LEVEL|SIGNIFICANT|INSIGNIFICANT|PROBABILITY|FALSE_ALARM|UNLIKELY)$")
NO_PROBABILITY = {
    "SAME_LEVEL",  # of arm rates, relative
    "_SAME_LEVEL",  # of specific forces, relative
}
USUAL_LEVELS = (0.05, 0.01, 0.005, 0.003, 0.001)


def modules():
    return [(name, tree) for name, tree in source_modules().items() if name != decisions.__name__]


def test_each_decision_is_made_somewhere():
    used = {
        name.attr if isinstance(name, ast.Attribute) else name.id
        for _, tree in modules()
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and node.attr in ("level", "limit")
        for name in ast.walk(node.value)
        if isinstance(name, ast.Name | ast.Attribute)
    }
    assert not set(all_decisions()) - used


def numbers(tree):
    """Names of a module that are bound to a float, with it."""
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            (target,) = node.targets if isinstance(node, ast.Assign) else (node.target,)
            pairs = (
                zip(target.elts, node.value.elts, strict=True)
                if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple)
                else [(target, node.value)]
            )
            for name, value in pairs:
                if isinstance(name, ast.Name) and isinstance(value, ast.Constant) and isinstance(value.value, float):
                    yield name.id, value.value


def test_no_other_module_has_a_level():
    elsewhere = [
        f"{module}: {name}"
        for module, tree in modules()
        for name, _ in numbers(tree)
        if LEVEL.search(name) and name not in NO_PROBABILITY
    ]
    assert not elsewhere


def is_probability(node):
    """Whether an expression is a p-value by its name, or by the function that returns it."""
    names = [
        n.attr if isinstance(n, ast.Attribute) else n.id
        for n in ast.walk(node)
        if isinstance(n, ast.Attribute | ast.Name)
    ]
    return any(
        name in ("p", "chance", "wald", "f_test", "f_tail", "chi_square_tail") or name.endswith("probability")
        for name in names
    )


def test_no_p_value_is_held_against_a_number_of_a_module():
    wrong = []
    for module, tree in modules():
        own = {name for name, value in numbers(tree) if 0 < value < 1}
        for node in ast.walk(tree):
            if not isinstance(node, ast.Compare) or not any(map(is_probability, [node.left, *node.comparators])):
                continue
            wrong += [
                f"{module}:{node.lineno}: {ast.unparse(node)}"
                for side in [node.left, *node.comparators]
                if (isinstance(side, ast.Name) and side.id in own)
                or (isinstance(side, ast.Constant) and side.value in USUAL_LEVELS)
            ]
    assert not wrong


@pytest.mark.parametrize("name", sorted(all_decisions()))
def test_limit_and_level_agree(name):
    decision = all_decisions()[name]
    assert 0 < decision.level < 1
    assert decision.procedures
    if math.isnan(decision.limit) or name == "EARTH_LINE_SEEN":
        return
    if name == "DIRECTION_WANDERS":  # a variance at its bound: half of chi-square with one degree of freedom
        assert decision.level == pytest.approx(chi2.sf(decision.limit, 1) / 2, rel=0.05)
    else:
        assert decision.level == pytest.approx(2 * norm.sf(decision.limit), rel=0.04)


@pytest.mark.parametrize(
    ("procedures", "share"),
    [
        (("tumble",), 0.0290),
        (("tumble gyro",), 0.0032),
        (("tumble mag",), 0.0066),
        (NINE_AXES, 0.0388),
        (("tumble prior",), 0.0500),
        (("tumble check",), 0.0500),
        (("thermal",), 0.0189),
        (("thermal gyro",), 0.0148),
        (("thermal check",), 0.0500),
        (("magnetometer",), 0.0086),
        (("magnetometer check",), 0.0500),
        (("rate",), 0.0388),
        (("rate turn",), 0.0148),
        (("rate prior",), 0.0100),
        (("centrifuge",), 0.0362),
        (("noise",), 0.0319),
        (("noise check",), 0.0500),
        (("gyro_array",), 0.0209),
        (("warmup",), 0.0045),
        (("compare",), 0.0500),
        (("fleet",), 0.0110),
    ],
)
def test_levels_of_a_procedure_add_up_to_no_more_than_is_stated(procedures, share):
    assert false_alarms(procedures) == pytest.approx(share, abs=5e-5)


def test_every_procedure_is_stated():
    stated = {name for mark in test_levels_of_a_procedure_add_up_to_no_more_than_is_stated.pytestmark
              for procedures, _ in mark.args[1] for name in procedures}  # fmt: skip
    assert {name for decision in all_decisions().values() for name in decision.procedures} == stated
    assert {name for procedures in MOST_FALSE_ALARMS for name in procedures} <= stated
