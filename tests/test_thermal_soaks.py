"""Loops of soaks: what biases differ by where a temperature is reached by warming, and where by cooling."""

from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from reference import thermal as reference

G = reference.G
NOISE = 60e-6
WAY = ((-20, "cooling"), (-6, "warming"), (20, "warming"), (46, "warming"), (60, "warming"), (46, "cooling"),
       (20, "cooling"), (-6, "cooling"))  # fmt: skip


def soaks(seed, loop, turn_on=2e-5):
    """Tables of 15 attitudes at each soak of a plan; `loop` in g per axis, of which the middle has all."""
    rng = np.random.default_rng([13, seed])
    triad, made = reference.Triad(rng), []
    for number, (at, side) in enumerate(WAY):
        place = (at - 20.0) / 40.0
        offset = G * np.array(loop) * (1 - place**2) * (1 if side == "warming" else -1)
        offset = offset + turn_on * G * rng.standard_normal(3)
        temperature = at + 1e-3 * rng.standard_normal(15)
        outputs = [triad.output(G * u, t, offset)
                   for u, t in zip(reference.directions(rng, 15), temperature, strict=True)]  # fmt: skip
        columns = {f"accel_{a}": np.array(outputs)[:, k] + NOISE * G * rng.standard_normal(15)
                   for k, a in enumerate("xyz")}  # fmt: skip
        columns |= {f"std_accel_{a}": np.full(15, NOISE * G) for a in "xyz"}
        units = dict.fromkeys(columns, "m/s^2") | {"temperature": "degC"}
        head = {"gravity": f"{G} m/s^2", "reached_by": side}
        made.append(
            il.Recording(
                columns=columns | {"temperature": temperature}, units=units, metadata=head, name=f"soak_{number}"
            )
        )
    return made


def fitted(seed, loop, **more):
    return il.fit_thermal(soaks(seed, loop, **more), degrees="3,2,1").calibration


def test_loops_of_soaks_are_found_and_taken_out_of_the_laws():
    loop = (4e-4, -3e-4, 2e-4)
    record = fitted(1, loop)
    assert record.fit["lag"] is None
    for axis, height in zip("xyz", loop, strict=True):
        found = record.fit[f"loop_{axis}"]
        assert found["fitted"]
        assert abs(found["value"] - height * G) < 4 * found["standard_uncertainty"]
        assert found["standard_uncertainty"] < 5e-5 * G
    assert any("biases differ between warming and cooling" in warning for warning in record.warnings)


def test_none_is_found_where_there_is_none(reduced):
    trials = 8 if reduced else 20
    records = [fitted(seed, (0.0, 0.0, 0.0)) for seed in range(trials)]
    assert sum(record.fit["loop_x"]["fitted"] for record in records) <= trials / 10  # 1 % each
    standard = [record.fit[f"loop_{a}"]["value"] / record.fit[f"loop_{a}"]["standard_uncertainty"]
                for record in records for a in "xyz"]  # fmt: skip
    assert 0.6 < np.sqrt(np.mean(np.square(standard))) < 1.4


def test_without_heads_nothing_is_said_and_a_wrong_word_is_refused():
    made = soaks(1, (4e-4, 0.0, 0.0))
    bare = [replace(each, metadata={"gravity": f"{G} m/s^2"}) for each in made]
    assert il.fit_thermal(bare, degrees="3,2,1").calibration.fit["loop_x"] is None
    wrong = [replace(made[0], metadata={**made[0].metadata, "reached_by": "heating"}), *made[1:]]
    with pytest.raises(
        il.errors.DataError, match=r"soak_0: reached_by 'heating' in the head: expected warming or cool"
    ):
        il.fit_thermal(wrong)
