# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from oracles_best import cached, simulated
from scipy.signal import lfilter
from test_smoother import smoothed

from abyssnav.estimation.learned import beacon_estimates, cause_weights, learned_parameters


def test_every_parameter_has_its_prior_beside_it():
    heard = cached()
    rows = learned_parameters(smoothed(heard), heard.dive.beacons.id, gradient_known=True)
    names = [row.name for row in rows]
    assert {"heading_offset", "dvl_scale", "sound_speed_scale", "clock"} <= set(names)
    assert "sound_speed_gradient" not in names
    assert all(np.isfinite([r.value, r.sigma, r.prior, r.prior_sigma]).all() for r in rows)
    assert all(r.sigma >= 0 and r.prior_sigma > 0 for r in rows)
    assert sorted({r.beacon_id for r in rows if r.beacon_id is not None}) == [1, 2, 3, 4]


def test_a_heading_offset_of_ten_degrees_is_learned():
    heard = simulated(1, 3600.0, "voyage_1", compass={"bias_deg": 10.0, "bias_sigma_deg": 0.0})
    rows = learned_parameters(smoothed(heard), heard.dive.beacons.id, gradient_known=True)
    (offset,) = [r for r in rows if r.name == "heading_offset"]
    assert offset.unit == "deg"
    assert abs(offset.value) == pytest.approx(10.0, abs=2.0)


def test_beacons_are_estimated_around_where_they_are_stated():
    heard = cached()
    beacons = heard.dive.beacons
    found = beacon_estimates(smoothed(heard), beacons)
    np.testing.assert_array_equal(found.id, beacons.id)
    assert np.abs(found.position_enu_m - beacons.position_enu_m).max() < 3.0
    assert np.all(found.sigma_enu_m > 0)
    assert np.all(found.turn_around_sigma_s < 1e-3)


def test_causes_carry_the_ids_of_the_beacons_and_add_up_to_one():
    heard = cached()
    rows = cause_weights(smoothed(heard), heard.dive.beacons.id)
    assert sum(row.weight for row in rows) == pytest.approx(1.0)
    assert {row.beacon_id for row in rows} >= {1, 2, 3, 4, None}
    assert rows[0].weight == max(row.weight for row in rows)
    assert rows[0].name == ""


def test_a_time_constant_is_as_uncertain_as_estimates_of_it_scatter():
    """Estimates of it from 300 simulated errors that last 100 time constants each."""
    result = smoothed(cached())
    rows = {row.name: row for row in learned_parameters(result, [1, 2, 3, 4], gradient_known=True)}
    row, span_s = rows["slow_heading_time"], np.ptp(result.setting.problem.t_node_s)
    stated = row.sigma / row.value * np.sqrt(span_s / row.value)

    generator, steps, fade = np.random.default_rng(1), 2000, np.exp(-1 / 20)
    kicks = generator.normal(0, np.sqrt(1 - fade**2), (300, steps))
    kicks[:, 0] /= np.sqrt(1 - fade**2)
    error = lfilter([1.0], [1.0, -fade], kicks)
    ratio = (error[:, 1:] * error[:, :-1]).sum(1) / (error[:, :-1] ** 2).sum(1)
    time = -1 / np.log(ratio)
    assert stated == pytest.approx(np.std(time) / 20 * np.sqrt(steps / 20), rel=0.15)
