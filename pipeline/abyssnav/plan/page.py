# SPDX-License-Identifier: Apache-2.0
"""The plan as one self-contained page: map, radius along the track, and what changes it."""

from html import escape
from pathlib import Path
from string import Template

import numpy as np

from abyssnav.outputs.html.render import head
from abyssnav.outputs.palette import BEACON, sequential
from abyssnav.plan.expect import Plan
from abyssnav.tables import Float
from abyssnav.version import __version__

_TEMPLATE = Path(__file__).with_name("plan.html")
#: Of the map's longer side and of the plot along the track, in pixels of the page.
_MAP_PX = 560.0
_PLOT_PX = (860.0, 240.0)
_EDGE_PX = 44.0
#: The most points that a line of the page has.
_POINTS = 800


def page(plan: Plan, name: str) -> str:
    """HTML of the plan, without any reference to a network."""
    track = plan.track
    return Template(_TEMPLATE.read_text(encoding="utf-8")).substitute(
        head=head(f"Plan {name}"),
        name=escape(name),
        version=__version__,
        headline=escape(headline(plan)),
        enough=escape(enough(plan)),
        map=_map(plan),
        scale=_scale(plan),
        plot=_plot(plan),
        changes=_changes(plan),
        beacons="".join(_beacon_rows(plan)),
        length=f"{_length_m(track.position_enu_m) / 1000:.1f}",
        hours=f"{track.t_s[-1] / 3600:.1f}",
        assumptions=escape(assumptions(plan)),
    )


def headline(plan: Plan) -> str:
    """The radius to expect, in a sentence."""
    final = plan.track.radius_95_m
    live = float(np.median(plan.track.filter_radius_95_m))
    return (
        f"95 % of the final track within {np.median(final):.1f} m, in real time within "
        f"{live:.1f} m; on a twentieth of the way the final radius is above "
        f"{np.percentile(final, 95):.1f} m."
    )


def enough(plan: Plan) -> str:
    """Where fewer beacons suffice, in a sentence."""
    two, one = plan.enough(plan.track.two_beacons_95_m), plan.enough(plan.track.one_beacon_95_m)
    whole = plan.enough(plan.track.radius_95_m)
    return (
        f"{plan.target_m:.1f} m is kept on {100 * whole:.0f} % of the track with all beacons, on "
        f"{100 * two:.0f} % with the two nearest and on {100 * one:.0f} % with the nearest alone, "
        "once the position is known to 10 m."
    )


def assumptions(plan: Plan) -> str:
    """What the figures rest on, in sentences."""
    layout = plan.layout
    return (
        "The posterior Cramér-Rao bound: no navigator does better on average, and ours comes "
        "within some 10 % of it. It "
        f"knows two-way times good to {1000 * layout.acoustics.sigma_s:g} ms, pings every "
        f"{layout.acoustics.ping_period_s:g} s of which {100 * layout.acoustics.detection:.0f} % "
        f"are answered, a compass of {layout.compass.bias_sigma_deg:g}°, a DVL of "
        f"{100 * layout.dvl.scale_sigma:g} %, and a sound speed good to "
        f"{layout.sound.error_sigma_mps:g} m/s. A beacon whose sigma is not stated counts with "
        "0.5 m an axis."
    )


def _length_m(position_m: Float) -> float:
    return float(np.sum(np.hypot(*np.diff(position_m[:, :2], axis=0).T)))


def _map(plan: Plan) -> str:
    """Map with north up: cells by their radius, the planned track, the beacons."""
    cells, (rows, columns) = plan.cells, plan.shape
    side_px = _MAP_PX / max(rows, columns)
    side_m = plan.side_m
    west_m, north_m = cells.east_m.min() - side_m / 2, cells.north_m.max() + side_m / 2

    def pixel(place_m: Float) -> Float:
        scale = side_px / side_m * np.array([1.0, -1.0])
        return np.asarray((place_m[:, :2] - [west_m, north_m]) * scale)

    corner = pixel(np.column_stack([cells.east_m, cells.north_m])) - side_px / 2
    largest_m = float(cells.radius_95_m.max())
    parts = [
        f'<rect x="{x:.1f}" y="{y:.1f}" width="{side_px + 0.3:.1f}" height="{side_px + 0.3:.1f}" '
        f'fill="{sequential(radius / largest_m)}"><title>{radius:.2f} m, in real time {live:.2f} m'
        f" ({east:+.0f} m east, {north:+.0f} m north)</title></rect>"
        for (x, y), radius, live, east, north in zip(
            corner.tolist(), cells.radius_95_m.tolist(), cells.filter_radius_95_m.tolist(),
            cells.east_m.tolist(), cells.north_m.tolist(), strict=True,
        )
    ]  # fmt: skip
    parts.append(_line(pixel(_thinned(plan.track.position_enu_m)), "track"))
    for (x, y), label in zip(
        pixel(plan.beacons.position_enu_m).tolist(), plan.beacons.name.tolist(), strict=True
    ):
        parts.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="6" fill="{BEACON}" class="beacon"/>'
            f'<text x="{x + 9:.1f}" y="{y + 4:.1f}" class="name">{escape(label)}</text>'
        )
    width, height = columns * side_px, rows * side_px
    kilometre = 1000 * side_px / side_m
    bar = kilometre if kilometre < width / 2 else kilometre / 10
    parts.append(
        f'<path d="M10 {height - 12:.1f}h{bar:.1f}" class="bar"/>'
        f'<text x="10" y="{height - 18:.1f}" class="name">'
        f"{'1 km' if bar == kilometre else '100 m'}</text>"
    )
    return (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" '
        f'aria-label="Map of the radius to expect, north up">{"".join(parts)}</svg>'
    )


def _scale(plan: Plan) -> str:
    """Colours of the map, and their radii."""
    largest_m = float(plan.cells.radius_95_m.max())
    swatches = "".join(
        f'<span><i style="background:{sequential(share)}"></i>{share * largest_m:.1f} m</span>'
        for share in np.linspace(0.0, 1.0, 6).tolist()
    )
    return f'<div class="scale">{swatches}</div>'


def _plot(plan: Plan) -> str:
    """Radius over time along the track."""
    track, (width, height) = plan.track, _PLOT_PX
    curves = {
        "final track": ("final", track.radius_95_m),
        "real time": ("live", track.filter_radius_95_m),
        "two nearest beacons": ("two", track.two_beacons_95_m),
    }
    settled = max(1, len(track) // 10)
    top_m = 1.15 * max(float(np.max(curve[settled:])) for _, curve in curves.values())
    minutes = track.t_s / 60

    def pixel(t_min: Float, radius_m: Float) -> Float:
        x = _EDGE_PX + (width - _EDGE_PX) * t_min / minutes[-1]
        y = (height - 24) * (1 - np.minimum(radius_m / top_m, 1.0))
        return np.column_stack([x, y])

    parts = []
    for level_m in _round_levels(top_m):
        y = float(pixel(minutes[:1], np.array([level_m]))[0, 1])
        parts.append(
            f'<path d="M{_EDGE_PX} {y:.1f}H{width}" class="grid"/>'
            f'<text x="{_EDGE_PX - 6}" y="{y + 4:.1f}" class="tick">{level_m:g} m</text>'
        )
    for t_min in _round_levels(float(minutes[-1])):
        x = float(pixel(np.array([t_min]), np.zeros(1))[0, 0])
        parts.append(f'<text x="{x:.1f}" y="{height - 6}" class="tick end">{t_min:g} min</text>')
    for label, (kind, curve) in curves.items():
        points = pixel(_thinned(minutes), _thinned(curve))
        parts.append(_line(points, kind, label))
    return (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" '
        f'aria-label="Radius along the planned track">{"".join(parts)}</svg>'
        '<p class="key"><b class="final">final track</b> <b class="live">in real time</b> '
        '<b class="two">final, with the two nearest beacons</b></p>'
    )


def _round_levels(top: float) -> list[float]:
    """Some four round numbers up to a largest."""
    step = 10.0 ** np.floor(np.log10(top / 4))
    step *= next(factor for factor in (1, 2, 5, 10) if top / (step * factor) <= 5)
    return [float(round(k * step, 6)) for k in range(int(top / step) + 1)]


def _line(points_px: Float, kind: str, label: str = "") -> str:
    way = "L".join(f"{x:.1f} {y:.1f}" for x, y in points_px.tolist())
    return f'<path d="M{way}" class="{kind}"><title>{escape(label or kind)}</title></path>'


def _thinned(rows: Float) -> Float:
    return rows[:: max(1, len(rows) // _POINTS)]


def _changes(plan: Plan) -> str:
    now = plan.changes[0]
    rows = []
    for change in plan.changes:
        percent = 100 * (change.radius_95_m / now.radius_95_m - 1)
        kind = "good" if percent < -2 else "bad" if percent > 2 else ""
        difference = "" if change is now else f"{percent:+.0f} %"
        rows.append(
            f"<tr><td>{escape(change.what)}</td><td>{change.radius_95_m:.2f}</td>"
            f"<td>{change.filter_radius_95_m:.2f}</td>"
            f'<td class="{kind}">{difference}</td></tr>'
        )
    return "".join(rows)


def _beacon_rows(plan: Plan) -> list[str]:
    beacons = plan.beacons
    return [
        f"<tr><td>{escape(name)}</td><td>{east:+.1f}</td><td>{north:+.1f}</td><td>{-up:.1f}</td>"
        f"<td>{sigma:g}</td></tr>"
        for name, (east, north, up), sigma in zip(
            beacons.name.tolist(), beacons.position_enu_m.tolist(), beacons.sigma_m.tolist(),
            strict=True,
        )
    ]  # fmt: skip
