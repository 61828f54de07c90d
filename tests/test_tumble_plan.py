"""Plans: as good as the published table, allowed by the fixture, and predicting what the bound says."""

import json
import re
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import imulab as il
from imulab.errors import ObservabilityError, OptionError
from imulab.procedures.tumble.plan import (
    attitude_picture,
    directions_of,
    fixture_candidates,
    head_candidates,
    information_rows,
    plan_attitudes,
    plan_recording,
    roll_pitch,
    turning,
)
from imulab.records.calibration import Calibration, Covariance
from reference import tumble as reference

G = 9.80665


@cache
def planned(order, attitudes, criterion="A"):
    """A plan of any attitudes, made once for all tests that look at it."""
    return plan_attitudes(order=order, attitudes=attitudes, criterion=criterion)


def worst(plan, stem):
    return max(value for name, value in plan.uncertainties(1.0).items() if name.startswith(stem))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "order", "table"),
    [
        (24, 2, {"k2": 1.2}),
        (24, 3, {"k2": 1.6, "k3": 2.1}),
        (24, 4, {"k2": 5.4, "k3": 3.0, "k4": 4.5}),
        pytest.param(48, 2, {"k2": 0.8}, marks=pytest.mark.further),
        pytest.param(48, 3, {"k2": 1.0, "k3": 1.4}, marks=pytest.mark.further),
        (48, 4, {"k2": 3.8, "k3": 2.0, "k4": 3.2}),
    ],
)
def test_plans_are_no_worse_than_the_table_of_the_method(count, order, table):
    """Worst axis per unit noise, chosen by A-optimality; the table has two digits, so half of the last is added."""
    plan = planned(order, count)
    for stem, value in table.items():
        assert worst(plan, stem) < value + 0.05, stem


@pytest.mark.slow
@pytest.mark.parametrize(("count", "order"), [(24, 2), (24, 4), pytest.param(48, 3, marks=pytest.mark.further)])
def test_the_axes_of_a_plan_are_alike_at_no_cost_in_the_sum(count, order):
    """x, y and z of each kind within 4 %, the sum within 1 % of the least that is found without balancing."""
    plan = planned(order, count)
    variance = np.diag(plan.covariance).reshape(-1, 3)
    assert np.sqrt(variance.max(axis=1) / variance.min(axis=1)).max() < 1.04
    least = {(24, 2): 8.2386, (24, 4): 191.69, (48, 3): 15.990}[count, order]  # of seeds 1 to 8
    assert variance.sum() < 1.01 * least


@pytest.mark.slow
@pytest.mark.parametrize("criterion", ["A", "D"])
def test_a_plan_is_better_in_its_criterion_than_random_attitudes_and_than_the_other(criterion):
    plans = {c: planned(4, 18, c) for c in "AD"}
    cost = {
        "A": lambda plan: np.trace(plan.covariance),
        "D": lambda plan: np.linalg.slogdet(plan.covariance)[1],
    }[criterion]
    other = "D" if criterion == "A" else "A"
    assert cost(plans[criterion]) < cost(plans[other])
    # 18 attitudes, order 4, 1 µg: a random set gives 70 ppm of scale factor error, an optimal one 2.8 (the method)
    assert worst(plans["D"], "scale") < 3.0


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_the_prediction_is_the_cramer_rao_bound_of_a_nominal_sensor(order):
    plan = plan_attitudes(order=order, attitudes=3 * (order + 2) + 4)
    truth = {n: (1.0 if n[0] == "s" else 0.0) for n in reference.names(order)}
    noise = 1e-5
    bound = reference.bound(plan.directions, truth, order, G, np.full((len(plan.directions), 3), noise * G))
    in_g = {"b": 1 / G, "s": 1.0, "m": 1.0, "2": G, "3": G**2, "4": G**3}
    for (name, value), variance in zip(plan.uncertainties(noise).items(), np.diag(bound), strict=True):
        assert value == pytest.approx(np.sqrt(variance) * in_g[name[1] if name[0] == "k" else name[0]], rel=1e-6), name


@pytest.mark.slow
def test_no_two_attitudes_have_the_same_axis_vertical():
    plan = plan_attitudes(order=1, attitudes=60)
    cosine = plan.directions @ plan.directions.T - 2 * np.eye(60)
    assert np.degrees(np.arccos(cosine.max())) >= 2.999


@pytest.mark.parametrize(
    ("order", "attitudes", "candidates"),
    [
        (1, 20, None),
        (2, 18, fixture_candidates(np.radians(15))),
        (2, 18, head_candidates(np.radians(5))),
    ],
)
@pytest.mark.slow
def test_a_plan_with_distinct_verticals_has_no_axis_vertical_twice(order, attitudes, candidates):
    """Within 5 degrees, up or down; without the rule, or with z vertical before, plans differ as they must."""
    plan = plan_attitudes(order=order, attitudes=attitudes, candidates=candidates, distinct_verticals=True)
    vertical = np.abs(plan.directions) > np.cos(np.radians(5))
    assert vertical.sum(axis=0).max() <= 1
    assert len(plan.directions) == attitudes
    assert plan.again == []
    free = plan_attitudes(order=order, attitudes=attitudes, candidates=candidates)
    assert np.trace(plan.covariance) < 1.3 * np.trace(free.covariance)


@pytest.mark.slow
def test_distinct_verticals_count_what_is_there_and_refuse_what_cannot_be():
    up = np.array([[0.0, 0.0, 1.0]])
    more = plan_attitudes(order=1, attitudes=12, already=up, distinct_verticals=True)
    assert np.abs(more.directions[:, 2]).max() < np.cos(np.radians(5))
    cube = np.vstack([np.eye(3), -np.eye(3), separated(12)])
    with pytest.raises(OptionError, match=r"list: 1\d candidate attitudes lie 3 deg apart and repeat no vertical axis"):
        plan_attitudes(order=1, attitudes=18, candidates=cube, source="list", distinct_verticals=True)


def test_the_command_plans_for_the_linearised_method_and_says_when_attitudes_are_few(imulab, tmp_path):
    plan = ["tumble", "plan", "--order", "1", "--noise", "1ug", "--from", "fixture:15"]

    def vertical(*arguments):
        done = imulab(*plan, *arguments, "-o", "p.csv")
        assert done.returncode == 0, done.stderr
        found = directions_of(il.read(tmp_path / "p.csv"))
        return (np.abs(found) > np.cos(np.radians(5))).sum(axis=0).max(), done.stdout

    few = "Too few to check the order: only 4 degrees of freedom: 13 attitudes hardly check whether order 1 is enough"
    most, said = vertical("--attitudes", "13", "--method", "linearised")
    assert most <= 1
    assert "no two have the same of x, y and z vertical" in said
    assert few in said
    most, said = vertical("--attitudes", "14", "--distinct-verticals")
    assert most <= 1
    assert "Too few" not in said
    most, said = vertical("--attitudes", "40", "--method", "linearised", "--repeated-verticals")
    assert "vertical" not in said
    shown = imulab(*plan, "--attitudes", "13", "--json")
    (warning,) = json.loads(shown.stdout)["warnings"]
    assert warning.startswith(few.partition(": ")[2])
    for arguments, message in (
        (["--method", "linearized"], "--method 'linearized': expected one of norm linearised"),
        (["--method", "linearised", "--order", "0"], "--order 0 needs method norm, found method linearised"),
    ):
        refused = imulab(*plan, "--attitudes", "13", *arguments)
        assert refused.returncode == 2
        assert refused.stderr.startswith(f"imulab: {message}")
        assert refused.stderr.count("\n") == 1


@pytest.mark.parametrize("make", [fixture_candidates, head_candidates])
def test_a_fixture_gets_only_attitudes_that_it_has(make):
    candidates = make(np.radians(15))
    plan = plan_attitudes(order=2, attitudes=18, candidates=candidates)
    nearest = (plan.directions @ candidates.T).max(axis=1)
    np.testing.assert_allclose(nearest, 1.0, atol=1e-12)
    assert len(np.unique(np.round(plan.directions, 6), axis=0)) == 18


def test_a_head_with_steps_of_90_degrees_is_blind():
    with pytest.raises(OptionError, match="6 different candidate attitudes; expected at least 9"):
        plan_attitudes(order=1, attitudes=9, candidates=head_candidates(np.radians(90)))
    with pytest.raises(ObservabilityError, match="misalignment_zx misalignment_zy"):
        plan_attitudes(
            order=1, attitudes=9, candidates=np.vstack([np.eye(3), -np.eye(3), [[0.6, 0.8, 0]] * 2, np.eye(3) + 1e-3])
        )


def separated(count):
    """Directions 10 deg apart or more."""
    apart = []
    for up in reference.random_attitudes(np.random.default_rng(3), 200):
        if not apart or (np.array(apart) @ up).max() < np.cos(np.radians(10)):
            apart.append(up)
    return np.array(apart[:count])


@pytest.mark.slow
def test_attitudes_are_put_down_twice_for_want_of_others():
    """24 candidates of which two are a degree apart, and candidates that have all been measured."""
    apart = separated(24)
    twin = apart[0] + np.radians(1) * np.cross(apart[0], [1.0, 0, 0])
    listed = np.vstack([apart[:23], twin / np.linalg.norm(twin)])
    alone = plan_attitudes(order=2, attitudes=23, candidates=listed)
    assert alone.again == []
    plan = plan_attitudes(order=2, attitudes=24, candidates=listed, source="list.csv")
    ((one, other),) = plan.again
    assert other == 24  # after all others
    np.testing.assert_allclose(plan.directions[one - 1], plan.directions[23], atol=np.radians(3))
    assert np.trace(plan.covariance) < np.trace(alone.covariance)
    best = min(
        np.trace(np.linalg.inv(i.T @ i))
        for i in (information_rows(np.vstack([apart[:23], up]), 2) for up in apart[:23])
    )
    assert np.trace(plan.covariance) == pytest.approx(best, rel=1e-3)
    more = plan_attitudes(order=2, attitudes=6, candidates=apart, already=apart)
    assert more.again == []
    assert (more.directions @ apart.T).max(axis=1) == pytest.approx(np.ones(6))


def test_a_fixture_of_eighteen_positions_serves_forty_holds_evenly():
    ups = separated(18)
    plan = plan_attitudes(order=2, attitudes=40, candidates=ups)
    times = np.bincount(np.argmax(plan.directions @ ups.T, axis=1), minlength=18)
    assert set(times) == {2, 3}
    assert sorted(np.argmax(plan.directions[:18] @ ups.T, axis=1)) == list(range(18))


def test_attitudes_already_there_are_taken_into_account():
    faces = np.vstack([np.eye(3), -np.eye(3)])
    more = plan_attitudes(order=1, attitudes=6, already=faces)
    assert more.already == 6
    rng = np.random.default_rng(1)
    truth = {n: (1.0 if n[0] == "s" else 0.0) for n in reference.names(1)}
    scale = np.array([1 / G] * 3 + [1.0] * 6)
    for _ in range(20):
        sets = np.vstack([faces, reference.random_attitudes(rng, 6)])
        random = reference.bound(sets, truth, 1, G, np.full((12, 3), G)) * np.outer(scale, scale)
        assert np.trace(more.covariance) < np.trace(random)
    # what a cube cannot see lies between its axes: each addition is far from every face
    assert np.degrees(np.arccos((more.directions @ faces.T).max())) > 30


def test_roll_and_pitch_are_those_of_another_library():
    plan = planned(2, 24)
    for up, (roll, pitch) in zip(plan.directions, roll_pitch(plan.directions), strict=True):
        body_to_level = Rotation.from_euler("ZYX", [0.3, pitch, roll])
        np.testing.assert_allclose(body_to_level.inv().apply([0, 0, 1]), up, atol=1e-12)


@pytest.mark.slow
def test_the_order_turns_less_than_the_list_as_chosen():
    plan = planned(4, 48)
    shuffled = np.random.default_rng(1).permutation(plan.directions)
    assert turning(plan.directions) < 0.5 * turning(shuffled)


def test_a_plan_reads_back_and_feeds_the_simulator_and_the_fit(tmp_path):
    plan = planned(2, 18)
    il.write_csv(plan_recording(plan), tmp_path / "plan.csv")
    read = directions_of(il.read(tmp_path / "plan.csv"))
    np.testing.assert_allclose(read, plan.directions, atol=1e-6)
    recording = il.simulate_tumble(attitudes=read, order=2, noise=1e-3 * G, seed=3, gyro=False)
    record = il.fit_tumble(il.find_attitudes(recording), order=2, gravity=G).calibration
    # the prediction for the noise that the attitudes turned out to have
    noise = np.median(record.data["attitudes"]["standard_uncertainty"]) / G
    for name, predicted in plan.uncertainties(noise).items():
        if name.startswith("k2"):
            assert record.parameters[name].standard_uncertainty * G == pytest.approx(predicted, rel=0.2), name


def test_letters_fit_on_their_faces():
    """No face is lettered larger than it is wide, and every picture has at least one letter."""
    for up in reference.random_attitudes(np.random.default_rng(7), 200):
        parts = re.findall(
            r'<polygon points="([^"]*)"[^>]*/>(?:<text [^>]*font-size="([\d.]+)")?', attitude_picture(up)
        )
        for outline, size in parts:
            corners = np.array([[float(c) for c in corner.split(",")] for corner in outline.split()])
            sides = np.linalg.norm(np.diff(corners, axis=0), axis=1)[:2]
            area = abs(np.cross(np.append(corners[1] - corners[0], 0), np.append(corners[2] - corners[1], 0))[2])
            assert not size or float(size) < area / sides.max()
        assert any(size for _, size in parts)


def test_three_degrees_off_cost_a_tenth():
    """As the sheet says."""
    rng = np.random.default_rng(8)
    for order, count in ((1, 12), (2, 24), (4, 24)):
        plan = planned(order, count)
        predicted, worst = np.sqrt(np.diag(plan.covariance)), []
        for _ in range(100):
            off = plan.directions + np.radians(3) / np.sqrt(2) * rng.standard_normal((count, 3))
            rows = information_rows(off / np.linalg.norm(off, axis=1, keepdims=True), order)
            worst.append((np.sqrt(np.diag(np.linalg.inv(rows.T @ rows))) / predicted).max())
        assert np.median(worst) < 1.1


def test_pictures_show_the_face_that_is_up():
    for up, text in (([0, 0, 1.0], "+z"), ([0, 0, -1.0], "−z"), ([1.0, 0, 0], "+x"), ([0, -1.0, 0], "−y")):
        picture = attitude_picture(np.array(up))
        assert f">{text}<" in picture
        opposite = ("−" if text[0] == "+" else "+") + text[1]
        assert f">{opposite}<" not in picture


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"order": 6, "attitudes": 30}, "order 6: expected 0 to 5"),
        ({"attitudes": 14}, "order 3 has 15 parameters"),
        ({"order": 2, "attitudes": 11}, "order 2 has 12 parameters"),
        ({"order": 1, "attitudes": 12, "criterion": "G"}, "expected one of A D"),
    ],
)
def test_impossible_plans_are_refused(options, message):
    with pytest.raises(OptionError, match=message):
        plan_attitudes(**options)


def test_the_command_writes_a_plan_and_a_sheet(imulab, tmp_path):
    done = imulab(
        "tumble", "plan", "--order", "2", "--attitudes", "14", "--noise", "5ug", "-o", "p.csv", "--report", "p.html"
    )
    assert done.returncode == 0, done.stderr
    assert "14 attitudes for order 2, criterion A" in done.stdout
    assert "for a noise of 5 µg" in done.stdout
    sheet = (tmp_path / "p.html").read_text()
    assert sheet.count("<svg ") == 14
    more = imulab(
        "tumble", "plan", "--order", "2", "--attitudes", "4", "--add", "p.csv", "--from", "fixture:15", "--noise", "1ug"
    )
    assert "4 attitudes with the 14 already there" in more.stdout
    for arguments, fragment in (
        (["--from", "fixture:7"], "expected a whole part of 360 deg"),
        (["--from", "nowhere.csv"], "nowhere.csv: no such file"),
        (["--noise", "0"], "expected more than 0"),
        (["-o", "p.txt"], "ends in .csv"),
        (["--criterion", "G"], "expected one of A D"),
    ):
        refused = imulab("tumble", "plan", "--order", "2", "--attitudes", "14", "--noise", "1ug", *arguments)
        assert refused.returncode == 2
        assert fragment in refused.stderr
        assert refused.stderr.count("\n") == 1


def test_add_takes_a_recording_and_a_record(imulab):
    imulab("tumble", "simulate", "-o", "t.csv", "--attitudes", "16", "--hold", "2", "--order", "1")
    imulab("tumble", "fit", "t.csv", "--gravity", str(G), "--order", "1", "-o", "t.json")
    found = [
        imulab("tumble", "plan", "--order", "2", "--attitudes", "3", "--add", file, "--noise", file)
        for file in ("t.csv", "t.json")
    ]
    for done in found:
        assert done.returncode == 0, done.stderr
        assert "3 attitudes with the 16 already there" in done.stdout
    noise = [float(re.search(r"noise of ([\d.]+) µg in", done.stdout)[1]) for done in found]
    # 0.7 mg samples at 100 Hz, holds of 2 s less their edges
    assert noise == pytest.approx([700 / np.sqrt(140)] * 2, rel=0.2)


@pytest.mark.slow
def test_noise_is_asked_for_and_order_3_is_the_default(imulab, tmp_path):
    silent = imulab("tumble", "plan", "--attitudes", "24")
    assert silent.returncode == 2
    assert silent.stderr.startswith(
        "imulab: --noise: expected the noise of |f| in one attitude, such as 20ug, or a rec"
    )
    assert silent.stderr.count("\n") == 1
    done = imulab("tumble", "plan", "--attitudes", "18", "--noise", "20ug")
    assert done.returncode == 0, done.stderr
    assert "18 attitudes for order 3" in done.stdout
    assert "Order 3 because attitudes for a lower one cannot show" in done.stdout
    imulab("tumble", "simulate", "-o", "few.csv", "--attitudes", "6", "--hold", "3", "--order", "1")
    few = imulab("tumble", "plan", "--attitudes", "18", "--noise", "few.csv", "--order", "1")
    assert float(re.search(r"noise of ([\d.]+) µg", few.stdout)[1]) == pytest.approx(700 / np.sqrt(240), rel=0.25)
    (tmp_path / "bare.csv").write_text("accel_x [g],accel_y [g],accel_z [g]\n1,0,0\n0,1,0\n0,0,1\n")
    bare = imulab("tumble", "plan", "--attitudes", "18", "--noise", "bare.csv")
    assert bare.stderr.startswith("imulab: bare.csv: a table without std_* columns does not say what noise")
    twice = imulab("tumble", "plan", "--attitudes", "8", "--noise", "1ug", "--order", "0", "--from", "head:90")
    assert twice.returncode == 0, twice.stderr
    assert re.search(r"Put down twice: \d and 7, \d and 8\.", twice.stdout)


def test_lists_and_records_that_are_none_are_refused_by_name(imulab, tmp_path):
    up = reference.random_attitudes(np.random.default_rng(5), 30)
    rows = [[repr(float(value)) for value in direction] for direction in up]

    def write(name, head, lines):
        (tmp_path / name).write_text("\n".join([head, *(",".join(line) for line in lines)]) + "\n")

    head = "up_x [1],up_y [1],up_z [1]"
    write("good.csv", head, rows)
    write("few.csv", head, rows[:5])
    write("inf.csv", head, [*rows[:6], ["1.0", "inf", "0.0"], *rows[6:]])
    angles = [[str(30 * i), str(30 * j)] for i in range(12) for j in range(-2, 3)]
    write("bare.csv", "roll,pitch", angles)
    write("metre.csv", "roll [deg],pitch [m]", angles)
    other = Calibration("warmup", {}, Covariance((), ()), {}, {})
    other.save(tmp_path / "other.json")
    for arguments, fragment in (
        (["--from", "inf.csv"], "inf.csv: row 7 (line 8), column up_y: expected a finite number, found inf"),
        (["--from", "bare.csv"], "bare.csv: column roll: expected an angle, as in roll [deg]; found the unit 1"),
        (["--from", "metre.csv"], "metre.csv: column pitch: expected an angle, as in pitch [deg]; found the unit m"),
        (["--from", "few.csv"], "few.csv: 5 different candidate attitudes; expected at least 12"),
        (["--from", "good.csv", "-o", "good.csv"], "good.csv: would overwrite good.csv"),
        (["--add", "other.json"], "other.json: a warmup record holds no attitudes; expected a tumble record"),
        (["--attitudes", "301"], "301 attitudes: expected 1 to 300"),
        (["--attitudes", "0", "--add", "good.csv"], "0 attitudes: expected 1 to 300"),
    ):
        refused = imulab("tumble", "plan", "--order", "2", "--noise", "1ug", "--attitudes", "14", *arguments)
        assert refused.returncode == 2, (arguments, refused.stderr)
        assert refused.stderr == f"imulab: {fragment}\n" or refused.stderr.startswith(f"imulab: {fragment}; "), (
            refused.stderr
        )
    assert (tmp_path / "good.csv").read_text().startswith(head)
