# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from oracles import ecef_to_geodetic, geodetic_to_ecef, linear_at, rotation_enu_body

from abyssnav.geometry import (
    body_to_enu,
    ellipse_95,
    enu_to_geodetic,
    geodetic_to_enu,
    interpolate,
    pairs,
    plane,
    wrap_angle,
)


def test_turning_a_body_vector_is_the_product_of_three_rotation_matrices():
    rng = np.random.default_rng(1)
    vectors = rng.normal(size=(200, 3))
    roll, pitch, heading = rng.uniform(-np.pi, np.pi, (3, 200))
    expected = [
        rotation_enu_body(*angles) @ vector
        for vector, *angles in zip(vectors, roll, pitch, heading, strict=True)
    ]
    np.testing.assert_allclose(body_to_enu(vectors, roll, pitch, heading), expected, atol=1e-14)


def test_a_level_vehicle_moves_by_equation_2():
    u, v, psi = 1.3, -0.2, np.radians(217.0)
    east, north, up = body_to_enu(np.array([u, v, 0.0]), 0.0, 0.0, psi)
    assert east == pytest.approx(v * np.cos(psi) + u * np.sin(psi), abs=1e-15)
    assert north == pytest.approx(-v * np.sin(psi) + u * np.cos(psi), abs=1e-15)
    assert up == 0.0


@pytest.mark.parametrize(
    ("body", "roll_deg", "pitch_deg", "heading_deg", "enu"),
    [
        ([1, 0, 0], 0, 0, 90, [1, 0, 0]),  # heading east, forward is east
        ([0, 1, 0], 0, 0, 0, [1, 0, 0]),  # heading north, starboard is east
        ([0, 0, 1], 0, 0, 45, [0, 0, -1]),  # down is down
        ([1, 0, 0], 0, 90, 0, [0, 0, 1]),  # nose up
        ([0, 1, 0], 90, 0, 0, [0, 0, -1]),  # starboard side down
    ],
)
def test_angles_have_the_signs_of_a_ship(body, roll_deg, pitch_deg, heading_deg, enu):
    angles = np.radians([roll_deg, pitch_deg, heading_deg])
    np.testing.assert_allclose(body_to_enu(np.array(body), *angles), enu, atol=1e-15)


def test_one_vector_is_turned_by_many_attitudes():
    heading = np.radians([0.0, 90.0, 180.0])
    turned = body_to_enu(np.array([2.0, 0.0, 0.0]), np.zeros(3), np.zeros(3), heading)
    np.testing.assert_allclose(turned, [[0, 2, 0], [2, 0, 0], [0, -2, 0]], atol=1e-15)


def test_wrapped_angles_lie_from_minus_pi_up_to_but_without_pi():
    angle = np.array([-np.pi, np.pi, 3 * np.pi, 0.5, -7.0, 1e4])
    wrapped = wrap_angle(angle)
    assert np.all((wrapped >= -np.pi) & (wrapped < np.pi))
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angle), atol=1e-11)


def test_interpolation_is_the_two_point_formula_for_columns_of_any_shape():
    rng = np.random.default_rng(2)
    knots = np.sort(rng.uniform(0, 10, 30))
    values = rng.normal(size=(30, 4, 2))
    t = np.concatenate([rng.uniform(-2, 12, 100), knots])
    expected = [linear_at(at, knots, values) for at in t]
    np.testing.assert_allclose(interpolate(t, knots, values), expected, atol=1e-12)


def test_at_a_knot_interpolation_gives_the_knots_value_to_the_bit():
    rng = np.random.default_rng(3)
    knots, values = np.cumsum(rng.uniform(0.1, 1, 50)), rng.normal(size=50)
    assert np.array_equal(interpolate(knots, knots, values), values)


def test_one_knot_is_held_everywhere():
    held = interpolate(np.array([-1.0, 5.0]), np.array([2.0]), np.array([[7.0, 8.0]]))
    assert held.tolist() == [[7.0, 8.0], [7.0, 8.0]]


PLACES = [(0.0, 0.0), (-23.5, 179.99), (67.3, -12.0), (-89.0, 45.0), (89.9, 10.0)]


@pytest.mark.parametrize(("latitude_deg", "longitude_deg"), PLACES)
def test_geodetic_to_enu_is_the_difference_of_two_places_in_space(latitude_deg, longitude_deg):
    rng = np.random.default_rng(4)
    lat = latitude_deg + rng.uniform(-0.05, 0.05, 20)
    lon = longitude_deg + rng.uniform(-0.05, 0.05, 20)
    height = rng.uniform(-11_000, 0, 20)
    origin = geodetic_to_ecef(latitude_deg, longitude_deg, 0.0)
    a, o = np.radians([latitude_deg, longitude_deg])
    axes = np.array([
        [-np.sin(o), np.cos(o), 0],
        [-np.sin(a) * np.cos(o), -np.sin(a) * np.sin(o), np.cos(a)],
        [np.cos(a) * np.cos(o), np.cos(a) * np.sin(o), np.sin(a)],
    ])  # fmt: skip
    expected = [
        axes @ (geodetic_to_ecef(*place) - origin) for place in zip(lat, lon, height, strict=True)
    ]
    found = geodetic_to_enu(latitude_deg, longitude_deg, lat, lon, height)
    np.testing.assert_allclose(found, expected, atol=1e-8)


@pytest.mark.parametrize(("latitude_deg", "longitude_deg"), PLACES)
def test_enu_to_geodetic_agrees_with_the_iterated_latitude(latitude_deg, longitude_deg):
    rng = np.random.default_rng(5)
    enu_m = rng.uniform(-50_000, 50_000, (20, 3)) * [1, 1, 0] + [0, 0, -6000]
    lat, lon, height = enu_to_geodetic(latitude_deg, longitude_deg, enu_m)
    back_m = geodetic_to_enu(latitude_deg, longitude_deg, lat, lon, height)
    np.testing.assert_allclose(back_m, enu_m, atol=1e-8)  # 10 nm: 2 ulp of Earth's radius each way
    for place in zip(lat, lon, height, strict=True):
        again = ecef_to_geodetic(geodetic_to_ecef(*place))
        # at 89.9 degrees a nanometre east is 5e-12 degrees of longitude
        assert again == pytest.approx(place, abs=1e-8, rel=1e-11)


@pytest.mark.parametrize("shape", [(), (5,), (3, 4)])
def test_vectors_become_complex_numbers_and_come_back(shape):
    vector_m = np.random.default_rng(6).normal(0, 1, (*shape, 2))
    number = plane(vector_m)
    assert number.shape == shape
    np.testing.assert_array_equal(number, vector_m[..., 0] + 1j * vector_m[..., 1])
    np.testing.assert_array_equal(pairs(number), vector_m)
    transposed = number.copy(order="F")
    np.testing.assert_array_equal(pairs(transposed), vector_m)


def test_a_degree_has_the_published_length_of_wgs_84():
    # Meridian and parallel degree at 45 N: 111,131.75 m and 78,846.81 m (WGS 84 handbook tables).
    step = 1e-3
    north = geodetic_to_enu(45.0, 0.0, np.array(45.0 + step), np.array(0.0), np.array(0.0))
    south = geodetic_to_enu(45.0, 0.0, np.array(45.0 - step), np.array(0.0), np.array(0.0))
    east = geodetic_to_enu(45.0, 0.0, np.array(45.0), np.array(step), np.array(0.0))
    assert (north[1] - south[1]) / (2 * step) == pytest.approx(111_131.75, abs=0.05)
    assert east[0] / step == pytest.approx(78_846.81, abs=0.05)


def test_the_error_ellipse_is_that_of_the_eigenvectors():
    rng = np.random.default_rng(5100)
    root = rng.normal(size=(200, 2, 2)) * rng.uniform(0.01, 100.0, (200, 1, 1))
    cov_m2 = root @ root.mT
    half_m, turn_rad = ellipse_95(cov_m2)
    variance_m2, axes = np.linalg.eigh(cov_m2)
    np.testing.assert_allclose(half_m**2 / -(2 * np.log(0.05)), variance_m2[:, ::-1], rtol=1e-6)
    along = np.einsum(
        "ni,ni->n", np.column_stack([np.cos(turn_rad), np.sin(turn_rad)]), axes[:, :, 1]
    )
    np.testing.assert_allclose(np.abs(along), 1.0, atol=1e-9)
