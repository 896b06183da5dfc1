# SPDX-License-Identifier: Apache-2.0
"""Bent rays against closed forms, the ray equation, Fermat's principle and published waters."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from test_acoustics import MUNK, beacons_around, profile, replies_to

from abyssnav.acoustics.ray_tracing import most_saved, travel_time
from abyssnav.acoustics.travel_time import (
    RayCheck,
    mean_sound_speed,
    predict_travel_time,
    ray_check,
    ray_geometry,
)
from abyssnav.tables import SoundSpeed

SIGMA_S = 0.002
RNG = np.random.default_rng
#: A warm current over cold water; 8 degrees C a hundred metres at the thermocline's steepest.
KUROSHIO = profile(
    [0, 50, 100, 200, 400, 600, 800, 1000, 1360],
    [1530, 1528, 1520, 1508, 1496, 1487, 1482, 1481, 1484.5],
)
SHALLOW = profile([0, 20, 60, 200], [1520, 1519, 1496, 1490])


def munk_mps(depth_m):
    eta = 2 * (depth_m - 1300) / 1300
    return 1500 * (1 + 0.00737 * (eta - 1 + np.exp(-eta)))


def anywhere(seed, n, depth_m=6000.0, distance_m=9000.0):
    rng = RNG(seed)
    return (*rng.uniform(0, depth_m, (2, n)), rng.uniform(0, distance_m, n))


def straight_time(of, depth_m, other_m, x):
    return np.hypot(x, depth_m - other_m) / mean_sound_speed(of, depth_m, other_m)


def arc_time(g, c1, c2, chord_m):
    """Along the circle between two points of one gradient, turning or not.

    arcosh(1 + g² D² / (2 c₁ c₂)) / g, in the form that does not cancel over short chords.
    """
    return 2 * np.arcsinh(g * chord_m / (2 * np.sqrt(c1 * c2))) / g


# --- closed forms -----------------------------------------------------------------------------


def test_in_water_of_one_speed_a_ray_is_straight():
    a, b, x = anywhere(1, 500)
    still = profile([0, 50, 6000], [1500, 1500, 1500])
    np.testing.assert_allclose(
        travel_time(still, a, b, x), np.hypot(a - b, x) / 1500, atol=1e-12, rtol=0
    )
    np.testing.assert_allclose(travel_time(still, a, a, x), x / 1500, atol=1e-12, rtol=0)


@pytest.mark.parametrize(("top_mps", "bottom_mps"), [(1480, 1560), (1560, 1480), (1400, 1900)])
@pytest.mark.parametrize("levels", [2, 12, 301])
def test_in_one_gradient_however_layered_a_ray_is_an_arc(top_mps, bottom_mps, levels):
    depth_m = np.linspace(-3000, 9000, levels)
    one = profile(depth_m, top_mps + (bottom_mps - top_mps) * (depth_m + 3000) / 12_000)
    g = (bottom_mps - top_mps) / 12_000
    a, b, x = anywhere(2, 300)
    b[:50] = a[:50]  # level: all of these turn
    b[50:80] = a[50:80] + 1e-6
    x[100:150] *= 1e-4  # and these are steep
    c1, c2 = (np.interp(z, one.depth_m, one.sound_speed_mps) for z in (a, b))
    found = travel_time(one, a, b, x)
    np.testing.assert_allclose(
        found, arc_time(abs(g), c1, c2, np.hypot(a - b, x)), atol=1e-12, rtol=1e-12
    )


@pytest.mark.parametrize("g", [1e-3, 1e-6, 1e-9])
def test_as_the_gradient_goes_the_arc_becomes_the_straight_line(g):
    a, b, x = anywhere(3, 200)
    b[:40] = a[:40]
    faint = profile([0, 6000], [1500, 1500 + 6000 * g])
    deep = a > 0.2 * x  # others would turn above the surface if the gradient were falling
    saved = straight_time(faint, a, b, x) - travel_time(faint, a, b, x)
    known = np.isfinite(saved)
    assert known[deep].mean() > 0.9
    expected = (x**3 * g**2 / 24 / 1500**3 * np.hypot(a - b, x) / np.maximum(x, 1e-9))[known]
    np.testing.assert_allclose(saved[known], expected, rtol=0.02, atol=1e-13)


def test_straight_down_the_time_is_the_integral_of_slowness():
    a, b, _ = anywhere(4, 200)
    expected = np.abs(a - b) / mean_sound_speed(MUNK, a, b)
    for x in (0.0, 1e-9, 1e-6):
        np.testing.assert_allclose(travel_time(MUNK, a, b, x), expected, atol=1e-12, rtol=0)
    assert travel_time(MUNK, 1000.0, 1000.0, 0.0)[0] == 0.0


# --- second roads -----------------------------------------------------------------------------


def integrated_time(a, b, x):
    """Shooting with the ray equation z'' = -(1 + z'²) c' / c in Munk's profile as it is."""
    from scipy.integrate import solve_ivp
    from scipy.optimize import brentq

    def turn(_, state):
        z, slope, _ = state
        eta = 2 * (z - 1300) / 1300
        gradient = 1500 * 0.00737 * 2 / 1300 * (1 - np.exp(-eta))
        bend = 1 + slope**2
        return [slope, -bend * gradient / munk_mps(z), np.sqrt(bend) / munk_mps(z)]

    def shoot(slope):
        way = solve_ivp(turn, (0, x), [a, slope, 0.0], method="DOP853", rtol=1e-13, atol=1e-12)
        return way.y[:, -1]

    chord = (b - a) / x
    slope = brentq(lambda s: shoot(s)[0] - b, chord - 0.2, chord + 0.2, xtol=1e-14)
    return shoot(slope)[2]


@pytest.mark.parametrize(
    ("a", "b", "x"),
    [
        (4920.0, 4950.0, 2000.0),  # turns below the deeper end
        (4920.0, 4950.0, 8000.0),
        (5000.0, 3000.0, 3000.0),
        (10.0, 5000.0, 1500.0),
        (900.0, 2600.0, 5000.0),  # through the sound channel
        (1000.0, 1010.0, 4000.0),  # turns above the shallower end
    ],
)
def test_finer_levels_converge_to_the_ray_equation_of_munks_profile(a, b, x):
    expected = integrated_time(a, b, x)
    misses = []
    for step_m in (8.0, 4.0, 0.25):
        depth_m = np.arange(0.0, 6200.0, step_m)
        misses.append(travel_time(profile(depth_m, munk_mps(depth_m)), a, b, x)[0] - expected)
    assert misses[0] / misses[1] == pytest.approx(4.0, rel=0.25)
    assert abs(misses[2]) < 1e-9


def jagged(seed):
    """A cast that goes up and down, as measured ones do."""
    rng = RNG(seed)
    depth_m = np.concatenate([[0.0], np.sort(rng.uniform(0, 3000, 40)), [3000.0]])
    return profile(depth_m, 1490 + np.cumsum(rng.normal(0, 1.5, 42)))


@pytest.mark.parametrize("seed", range(4))
def test_in_jagged_water_time_and_distance_are_snells_by_quadrature(seed):
    """Shoots rays of known p, integrates both over fine steps, and asks for the time back."""
    of = jagged(seed)
    fine_m = np.unique(np.concatenate([np.linspace(200, 2700, 100_001), of.depth_m]))
    fine_m = fine_m[(fine_m >= 200) & (fine_m <= 2700)]
    middle, h = 0.5 * (fine_m[1:] + fine_m[:-1]), np.diff(fine_m)
    c = np.interp(middle, of.depth_m, of.sound_speed_mps)
    for cosine in (0.02, 0.4, 0.8, 0.95):
        p = cosine / c.max()
        sine = np.sqrt(1 - (p * c) ** 2)
        x, t = np.sum(p * c / sine * h), np.sum(h / (c * sine))
        assert travel_time(of, 200.0, 2700.0, x)[0] == pytest.approx(t, abs=1e-9)
        assert travel_time(of, 2700.0, 200.0, x)[0] == pytest.approx(t, abs=1e-9)


def path_times(a, b, x, bend_m):
    """Times along n bent chords, each bend a sum of k polynomials that are 0 at both ends."""
    node, weight = np.polynomial.legendre.leggauss(100)
    u = np.polynomial.Polynomial([0.5, 0.5])  # of the node: 0 to 1 along the chord
    shape = [
        u * (1 - u) * np.polynomial.Legendre.basis(k).convert(kind=np.polynomial.Polynomial)
        for k in range(bend_m.shape[1])
    ]
    z = a + (b - a) * u(node) + bend_m @ [f(node) for f in shape]
    slope = (b - a + bend_m @ [2 * f.deriv()(node) for f in shape]) / x
    return 0.5 * x * (np.sqrt(1 + slope**2) / munk_mps(z)) @ weight


@pytest.mark.parametrize(("a", "b", "x"), [(4920.0, 4960.0, 6000.0), (300.0, 4000.0, 3000.0)])
def test_no_other_path_is_sooner_and_the_soonest_of_them_is_the_ray(a, b, x):
    depth_m = np.arange(0.0, 6200.0, 1.0)
    ray_s = travel_time(profile(depth_m, munk_mps(depth_m)), a, b, x)[0]
    bend_m = np.zeros(10)
    unit = np.eye(len(bend_m))
    for _ in range(6):  # Newton's steps on differences over a metre
        time_s = lambda move: path_times(a, b, x, bend_m + move)  # noqa: E731, B023
        ahead, behind, here = time_s(unit), time_s(-unit), time_s(0 * unit[:1])
        both = time_s((unit[:, None] + unit).reshape(-1, len(unit))).reshape(len(unit), -1)
        curvature = both - ahead[:, None] - ahead + here
        bend_m = bend_m - np.linalg.solve(curvature, 0.5 * (ahead - behind))
    best_s = path_times(a, b, x, bend_m[None])[0]
    assert best_s == pytest.approx(ray_s, abs=5e-9)
    others = path_times(a, b, x, bend_m + RNG(5).normal(0, 30, (500, 10)) / np.arange(1, 11))
    assert others.min() > ray_s


def test_there_and_back_upright_and_upside_down_take_the_same_time():
    a, b, x = anywhere(6, 400)
    there = travel_time(MUNK, a, b, x)
    np.testing.assert_array_equal(there, travel_time(MUNK, b, a, x))
    turned = SoundSpeed(-MUNK.depth_m[::-1], MUNK.sound_speed_mps[::-1])
    np.testing.assert_allclose(travel_time(turned, -a, -b, x), there, atol=1e-13, rtol=0)


def test_rays_do_not_hear_of_each_other():
    a, b, x = anywhere(7, 2000)
    b[::4] = a[::4] + 30
    together = travel_time(MUNK, a, b, x)
    for cut in (1, 7, 100, 1501):
        np.testing.assert_array_equal(travel_time(MUNK, a[:cut], b[:cut], x[:cut]), together[:cut])


# --- where there is no ray --------------------------------------------------------------------


def test_behind_faster_water_there_is_shadow_from_the_limiting_ray_on():
    """The ray level at the fast level's peak goes (w₁ / g₁ + w₂ / g₂) / p, none goes farther."""
    hill = profile([0, 500, 1000], [1490, 1510, 1480])
    p = 1 / 1510
    limit_m = sum(np.sqrt(1 - (p * c) ** 2) / (p * g) for c, g in ((1490, 0.04), (1480, 0.06)))
    time_s = travel_time(hill, 0.0, 1000.0, limit_m * np.array([0.999999, 1.000001]))
    assert np.isfinite(time_s).tolist() == [True, False]


def test_without_water_above_that_turns_it_a_ray_that_needs_it_is_in_shadow():
    falling = profile([0, 1000], [1520, 1500])
    g, c = 0.02, np.interp(20.0, [0, 1000], [1520, 1500])
    highest_m = np.sqrt(1520**2 - c**2) / g  # from level at the surface down to 20 m
    x = 2 * highest_m * np.array([0.9999, 1.0001])
    assert np.isfinite(travel_time(falling, 20.0, 20.0, x)).tolist() == [True, False]


@pytest.mark.parametrize("what", [(np.nan, 1.0, 1.0), (1.0, np.inf, 1.0), (1.0, 1.0, np.nan)])
def test_what_is_not_a_number_has_no_ray_and_spoils_no_other(what):
    found = travel_time(MUNK, *np.array([what, (100.0, 900.0, 500.0)]).T)
    assert np.isnan(found[0])
    assert found[1] == travel_time(MUNK, 100.0, 900.0, 500.0)[0]


# --- the judge --------------------------------------------------------------------------------


def savings(water, seed):
    """What rays anywhere in the water save, and the bound on it; those of some bend only."""
    depth_m = water.depth_m[-1]
    a, b, x = anywhere(seed, 2000, depth_m, min(3 * depth_m, 8000.0))
    straight_s = straight_time(water, a, b, x)
    saved_s = straight_s - travel_time(water, a, b, x)
    bound_s = most_saved(water, a, b, x, mean_sound_speed(water, a, b))
    known = np.isfinite(saved_s) & (bound_s < 0.003 * straight_s)  # what second order means
    assert known.sum() > 200
    return saved_s[known], bound_s[known]


@pytest.mark.parametrize("water", [MUNK, KUROSHIO, SHALLOW, profile([0, 5000], [1480, 1560])])
def test_a_straight_ray_is_never_sooner_nor_later_than_the_bound_says(water):
    saved_s, bound_s = savings(water, 8)
    assert saved_s.min() > -1e-12
    assert np.all(saved_s < 1.05 * bound_s + 1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_in_jagged_water_the_bound_misses_next_to_none_and_none_that_counts(seed):
    saved_s, bound_s = savings(jagged(seed), seed)
    assert saved_s.min() > -1e-12
    assert np.mean(saved_s > bound_s + 1e-12) < 2e-3
    assert saved_s[bound_s < SIGMA_S / 20].max() < SIGMA_S / 20


def dive(water, *, depth_m, beacon_depth_m, distance_m, n=400, seed=0):
    """Replies at rest, whose times are twice the bent ray's, and where the vehicle is."""
    rng = RNG(seed)
    place = np.column_stack([np.zeros((n, 2)), -rng.uniform(*beacon_depth_m, n)])
    beacons = dataclasses.replace(
        beacons_around(n), position_enu_m=place, turn_around_s=np.full(n, 0.2)
    )
    at_m, x = rng.uniform(*depth_m, n), rng.uniform(*distance_m, n)
    time_s = 2 * travel_time(water, at_m, -place[:, 2], x)
    heard = np.isfinite(time_s)
    replies = replies_to(beacons, time_s + 0.2, depth_m=at_m)
    return replies[heard], np.column_stack([x, 0 * x])[heard]


DEEP = {"depth_m": (4850, 5950), "beacon_depth_m": (4900, 6000)}
GEOMETRIES = {
    "deep": (MUNK, {**DEEP, "distance_m": (500, 8000)}),
    "from the surface": (
        MUNK,
        {"depth_m": (0, 20), "beacon_depth_m": (4900, 6000), "distance_m": (0, 8000)},
    ),
    "shallow": (
        SHALLOW,
        {"depth_m": (60, 190), "beacon_depth_m": (150, 195), "distance_m": (50, 3000)},
    ),
    "survey": (
        KUROSHIO,
        {"depth_m": (20, 30), "beacon_depth_m": (1330, 1355), "distance_m": (0, 1200)},
    ),
}


@pytest.mark.parametrize("name", GEOMETRIES)
def test_the_model_with_a_speed_from_the_measured_time_gives_the_rays_time(name):
    """What the approximation leaves is within σ / 10 where straight, σ / 200 where traced."""
    water, geometry = GEOMETRIES[name]
    replies, at_m = dive(water, **geometry)
    of = ray_geometry(replies, water, sigma_s=SIGMA_S)
    straight = ray_geometry(replies, water, sigma_s=np.inf)
    missed_s = np.abs(predict_travel_time(at_m, at_m, of).time_s - of.flight_time_s)
    traced = of.speed_ping_mps != straight.speed_ping_mps
    assert missed_s[~traced].max(initial=0) < SIGMA_S / 10
    assert missed_s[traced].max(initial=0) < SIGMA_S / 200


def test_over_a_surveyed_array_the_straight_ray_is_good_to_hundredths_of_a_millisecond():
    water, geometry = GEOMETRIES["survey"]
    replies, at_m = dive(water, **geometry, n=3000)
    straight = ray_geometry(replies, water, sigma_s=np.inf)
    missed_s = predict_travel_time(at_m, at_m, straight).time_s - straight.flight_time_s
    assert missed_s.min() > -1e-12
    assert 0.005e-3 < np.median(missed_s) < 0.05e-3
    assert 0.05e-3 < missed_s.max() < 0.3e-3


def test_noise_of_the_time_moves_the_speed_by_nothing_that_counts():
    water, geometry = GEOMETRIES["deep"]
    replies, at_m = dive(water, **geometry)
    noisy = dataclasses.replace(
        replies, travel_time_s=replies.travel_time_s + RNG(9).normal(0, SIGMA_S, len(replies))
    )
    clean_s, noisy_s = (
        predict_travel_time(at_m, at_m, ray_geometry(r, water, sigma_s=1e-6)).time_s
        for r in (replies, noisy)
    )
    assert np.abs(noisy_s - clean_s).max() < SIGMA_S / 500


def test_a_small_sigma_traces_what_a_large_one_leaves_straight():
    water, geometry = GEOMETRIES["survey"]
    replies, _ = dive(water, **geometry)
    traced = [
        ray_check(ray_geometry(replies, water, sigma_s=s), replies, water, sigma_s=s)
        for s in (np.inf, 0.002, 1e-5)
    ]
    assert traced[0].n_traced == 0
    assert traced[0].n_traced <= traced[1].n_traced < traced[2].n_traced


def test_the_check_tells_how_many_are_bent_and_the_most_that_it_saves():
    level = profile([0, 6000], [1450, 1550])
    g, c = 100 / 6000, 1450 + 5000 * 100 / 6000
    x = np.array([500.0, 4000.0, 8000.0])
    beacons = beacons_around(3, depth_m=5000.0)
    place = np.column_stack([x, 0 * x, -5000 + 0 * x])
    beacons = dataclasses.replace(beacons, position_enu_m=place, turn_around_s=np.zeros(3))
    bent_s = 2 * 2 / g * np.arcsinh(g * x / 2 / c)
    replies = replies_to(beacons, bent_s, depth_m=5000.0)
    of = ray_geometry(replies, level)
    found = ray_check(of, replies, level)
    assert (found.n_replies, found.n_traced, found.n_shadow) == (3, 2, 0)
    assert found.largest_s == pytest.approx(2 * x[2] / c - bent_s[2], rel=1e-2)


def test_in_shadow_the_straight_ray_is_kept_and_counted():
    hill = profile([0, 500, 1000], [1490, 1510, 1480])
    beacons = dataclasses.replace(
        beacons_around(1), position_enu_m=np.array([[12000.0, 0, -900]]), turn_around_s=np.zeros(1)
    )
    replies = replies_to(beacons, 2 * 12000 / 1495, depth_m=100.0)
    of, straight = (ray_geometry(replies, hill, sigma_s=s) for s in (SIGMA_S, np.inf))
    np.testing.assert_array_equal(of.speed_ping_mps, straight.speed_ping_mps)
    found = ray_check(of, replies, hill)
    assert found == RayCheck(n_replies=1, n_traced=0, n_shadow=1, largest_s=0.0)


def test_a_wild_time_keeps_the_straight_ray_and_spoils_no_other():
    wild_s = np.array([np.nan, np.inf, -np.inf, -1e300, 0.0, 0.2, 0.21, 27.0, 1e9, 1e300])
    n = len(wild_s) + 1
    beacons = beacons_around(n)
    beacons = dataclasses.replace(beacons, turn_around_s=np.full(n, 0.2))
    replies = replies_to(beacons, np.append(wild_s, 8.0), depth_m=4800.0)
    of, straight = (ray_geometry(replies, MUNK, sigma_s=s) for s in (SIGMA_S, np.inf))
    # 0.21 s is shorter than the depths are apart; 27 s is farther than sound is heard.
    np.testing.assert_array_equal(of.speed_reply_mps[:-1], straight.speed_reply_mps[:-1])
    assert of.speed_reply_mps[-1] > straight.speed_reply_mps[-1]


# --- authority --------------------------------------------------------------------------------


def test_through_the_published_check_casts_a_ray_takes_the_published_waters_time():
    """TEOS-10's check casts: c and depth within their published tolerances, and rays in them."""
    gsw = pytest.importorskip("gsw", reason="gsw is not installed")
    path = Path(gsw.__file__).parent / "tests" / "gsw_cv_v3_0.npz"
    if not path.exists():
        pytest.skip("this gsw has no check casts with it")
    with np.load(path) as checks:
        p_dbar, latitude = checks["p_chck_cast"], checks["lat_chck_cast"]
        c = gsw.sound_speed(checks["SA_chck_cast"], checks["CT_chck_cast"], p_dbar)
        z = gsw.z_from_p(p_dbar, latitude)
        for found, name in ((c, "sound_speed"), (z, "z_from_p")):
            known = np.isfinite(found) & np.isfinite(checks[name])
            assert known.sum() > 90
            assert np.abs(found - checks[name])[known].max() <= checks[f"{name}_ca"]
    for cast in range(c.shape[1]):
        known = np.isfinite(c[:, cast] + z[:, cast])
        water = SoundSpeed(-z[known, cast], c[known, cast])
        bottom_m = water.depth_m[-1]
        x = np.array([0.0, 0.1, 0.3]) * bottom_m
        bent_s = travel_time(water, 0.0, bottom_m, x)
        down_s = np.trapezoid(1 / water.sound_speed_mps, water.depth_m)
        assert bent_s[0] == pytest.approx(down_s, rel=1e-5)
        saved = 1 - bent_s * bottom_m / (bent_s[0] * np.hypot(x, bottom_m))
        assert np.all(saved[1:] > 0)
        assert saved[2] / saved[1] == pytest.approx(9.0, rel=0.1)  # as the square of x
