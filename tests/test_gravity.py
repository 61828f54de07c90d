"""Normal gravity against published values and against the exact field of the ellipsoid."""

import math

import pytest

from imulab.errors import OptionError
from imulab.gravity import normal_gravity


# NIMA TR8350.2 (3rd edition): gravity at the equator and at the pole of WGS 84, m/s^2; 45 deg as printed by the usual
# tables of WGS 84 normal gravity.
@pytest.mark.parametrize(
    ("degrees", "published"),
    [(0, 9.7803253359), (45, 9.8061977694), (-45, 9.8061977694), (90, 9.8321849379), (-90, 9.8321849379)],
)
def test_gravity_on_the_ellipsoid_is_the_published_one(degrees, published):
    assert normal_gravity(math.radians(degrees)) == pytest.approx(published, abs=0.6e-10)


def test_the_first_metres_cost_the_usual_free_air_gradient():
    # 0.3086 mGal/m, a number of four digits for middle latitudes; the second-order term is 7e-10 m/s^2 at 100 m.
    latitude = math.radians(45)
    fall = normal_gravity(latitude) - normal_gravity(latitude, 100.0)
    assert fall / 100.0 == pytest.approx(3.086e-6, abs=0.0006e-6)


A, F = 6378137.0, 1 / 298.257223563  # m; TR8350.2 tables 3.1 to 3.4
GM, OMEGA = 3986004.418e8, 7292115e-11  # m^3/s^2, rad/s


def exact_gravity(latitude: float, height: float) -> float:
    """Length of the gradient of the normal potential, Heiskanen and Moritz, Physical Geodesy (1967), 2-62."""
    b = A * (1 - F)
    e = math.sqrt(A * A - b * b)

    def q(u: float) -> float:  # as its series in e/u, which does not cancel
        return 2 * sum((-1) ** (n + 1) * n / ((2 * n + 1) * (2 * n + 3)) * (e / u) ** (2 * n + 1) for n in range(1, 12))

    def potential(p: float, z: float) -> float:
        r2 = p * p + z * z - e * e
        u = math.sqrt(r2 / 2 * (1 + math.sqrt(1 + 4 * e * e * z * z / (r2 * r2))))
        sine2 = (z / u) ** 2
        ring = OMEGA**2 * (A * A * q(u) / q(b) * (sine2 - 1 / 3) + (u * u + e * e) * (1 - sine2)) / 2
        return GM / e * math.atan2(e, u) + ring

    n = A / math.sqrt(1 - F * (2 - F) * math.sin(latitude) ** 2)
    p = (n + height) * math.cos(latitude)
    z = (n * (1 - F) ** 2 + height) * math.sin(latitude)
    step = 100.0  # m: truncation g (step/a)^2 = 2.4e-9, rounding 1e-16 * 6e7 / 200 = 4e-11 m/s^2
    along_p = (potential(p + step, z) - potential(p - step, z)) / (2 * step)
    along_z = (potential(p, z + step) - potential(p, z - step)) / (2 * step)
    return math.hypot(along_p, along_z)


@pytest.mark.parametrize("degrees", [0, 23, 47.3, -61, 89])
@pytest.mark.parametrize("height", [-500.0, 0.0, 250.0, 3000.0, 10000.0])
def test_gravity_above_the_ellipsoid_is_the_gradient_of_the_normal_potential(degrees, height):
    latitude = math.radians(degrees)
    # The series in h/a stops after the second term: the third is 4 g (h/a)^3. The second-order coefficient neglects
    # the flattening; the first-order one, by Bruns' formula gamma (1/M + 1/N) + 2 omega^2, 3/2 (f^2 + m^2).
    ratio, m = abs(height) / A, 0.00345
    bound = 9.9 * (4 * ratio**3 + 9 * F * ratio**2 + 3.2 * (F**2 + m**2) * ratio) + 4e-9
    assert normal_gravity(latitude, height) == pytest.approx(exact_gravity(latitude, height), abs=bound)


def test_north_and_south_are_alike():
    assert normal_gravity(0.7, 1234.0) == normal_gravity(-0.7, 1234.0)


@pytest.mark.parametrize("degrees", [90.001, -91, 180, math.nan, math.inf])
def test_a_latitude_beyond_the_pole_is_refused(degrees):
    with pytest.raises(OptionError, match=rf"latitude {degrees:g} deg: expected -90 to 90 deg"):
        normal_gravity(math.radians(degrees))


@pytest.mark.parametrize("height", [-500.1, 10000.5, math.nan])
def test_a_height_out_of_range_is_refused(height):
    with pytest.raises(OptionError, match=rf"height {height:g} m: expected -500 to 10000 m"):
        normal_gravity(0.5, height)


def test_a_place_may_be_a_text_and_degrees_without_one_are_told_how_to_be_written():
    assert normal_gravity("48.1 deg", "520 m") == normal_gravity(math.radians(48.1), 520.0)
    with pytest.raises(OptionError, match=r'expected -90 to 90 deg; numbers are rad, degrees are written "48.1 deg"'):
        normal_gravity(48.1)
