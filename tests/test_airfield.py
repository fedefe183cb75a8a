import numpy as np
import pytest
from numba import njit

import shortfinal as sf
from shortfinal.scene.airfield import add_lights, away, lights, paved, random_airfield, record
from shortfinal.scene.noise import noise_table

GRASS = np.array([0.2, 0.25, 0.1])
CAMERA = sf.Camera(800, 600, 900, 900, 399.5, 299.5)


@njit
def _shade(record, table, points, out):
    rgb = np.empty(3)
    for n in range(points.shape[0]):
        rgb[:] = 0.0
        out[n, 3] = paved(record[0], table, points[n, 0], points[n, 1], 0.0, rgb)
        out[n, :3] = rgb


@njit
def _away(record, points, out):
    for n in range(points.shape[0]):
        out[n] = away(record[0], points[n, 0], points[n, 1])


def airfield(length=2000.0, width=45.0, seed=0, **changes):
    """Grey pavement, white paint without wear, nothing beside; then the changes."""
    field = random_airfield(np.random.default_rng(seed), sf.Runway(length, width), GRASS)
    grey = np.full(3, 0.2)
    field = field._replace(
        surface=grey, concrete=np.zeros(6), patches=np.zeros(2), rubber=np.zeros((2, 4)), paint=np.ones(3), wear=0.0,
        other=np.zeros(6), strips=np.zeros((16, 9)), shoulder_width=0.0, verge=np.zeros(5), side_dash=0.0,
    )  # fmt: skip
    return field._replace(**changes)


def colours(field, points):
    out = np.empty((len(points), 4))
    _shade(record(field), noise_table(), np.asarray(points, float), out)
    return out


def painted(field, x, y):
    x, y = (v.ravel() for v in np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float)))
    return colours(field, np.column_stack([x, y]))[:, 0] > 0.6


def with_bars(seeds, **kwargs):
    fields = (airfield(seed=s, **kwargs) for s in seeds)
    return [f for f in fields if f.bars[2] > 0]


@pytest.mark.parametrize(("width", "stripes"), [(18, 4), (23, 6), (30, 8), (45, 12), (60, 16)])
@pytest.mark.parametrize("end", [0, 1])
def test_threshold_stripes_number_as_annex_14_says(width, stripes, end):
    y = (np.arange(100 * width) + 0.5) / 100 - width / 2
    for field in with_bars(range(12), width=float(width), side_stripe=0.0):
        inside = field.bars[0] + field.bars[1] / 2
        row = painted(field, inside if end == 0 else field.length - inside, y).astype(int)
        assert np.count_nonzero(np.diff(np.concatenate([[0], row, [0]])) == 1) == stripes
        np.testing.assert_array_equal(row, row[::-1])  # symmetric about the centre line
        assert not row[np.abs(y) > width / 2 - 0.45].any()


def test_no_paint_before_a_threshold_without_a_pad():
    field = with_bars(range(20), pad=np.zeros((2, 7)), threshold_line=np.zeros(2))[0]
    assert colours(field, [[-0.5, 0.0], [field.length + 0.5, 0.0]])[:, 3].tolist() == [0, 0]


@pytest.mark.parametrize(("length", "begin"), [(790.0, 150.0), (1000.0, 250.0), (2000.0, 300.0), (3000.0, 400.0)])
def test_the_aiming_point_begins_where_table_5_1_says(length, begin):
    width, space = {150.0: (4.0, 6.0), 250.0: (6.0, 9.0)}.get(begin, (6.0, 18.0))
    field = airfield(length, 45.0, aiming=np.array([begin, 45.0, width, space / 2]), touchdown=np.zeros(2))
    inside = space / 2 + width / 2
    for y in (-inside, inside):
        assert painted(field, [begin - 0.1, begin + 0.1, begin + 44.9, begin + 45.1], y).tolist() == [0, 1, 1, 0]
    assert painted(field, begin + 20, [space / 2 - 0.1, space / 2 + width + 0.1]).tolist() == [0, 0]
    # What is drawn at random begins there in most cases, and never off the runway.
    begins = np.array(
        [random_airfield(np.random.default_rng(s), sf.Runway(length, 45.0), GRASS).aiming for s in range(60)]
    )
    there = begins[begins[:, 1] > 0, 0]
    assert np.mean(there == begin) > 0.4
    assert (there < 0.6 * length).all()


def test_side_stripes_end_at_the_corner():
    field = airfield(side_stripe=0.9, bars=np.zeros(6), threshold_line=np.zeros(2), pad=np.zeros((2, 7)))
    assert painted(field, 0.05, [22.45, 21.65, 21.55, -22.45]).tolist() == [1, 1, 0, 1]
    assert colours(field, [[0.05, 22.55], [-0.05, 22.4]])[:, 3].tolist() == [0, 0]


def test_a_displaced_threshold_has_arrows_and_carries_the_stripes_on():
    pad = np.array([[200.0, 0.2, 0.2, 0.2, 1.0, 1.0, 1.0]] * 2)
    field = airfield(side_stripe=0.9, pad=pad, threshold_line=np.zeros(2), touchdown=np.zeros(2))
    x = -np.arange(0.5, 199.0, 0.5)
    assert 0.4 < painted(field, x, 0.0).mean() < 0.55  # shafts of 28 m every 60
    assert painted(field, x, 22.2).all()
    assert painted(field, x, -22.2).all()
    head = painted(field, -8.0, (np.arange(120) + 0.5) / 20 - 3)
    assert head.any()
    np.testing.assert_array_equal(head, head[::-1])


def test_touchdown_pairs_follow_the_landing_distance():
    counts = {850: 1, 1000: 2, 1300: 3, 2000: 4, 2600: 6}  # Annex 14, 5.2.6.3
    for length, pairs in counts.items():
        drawn = {
            random_airfield(np.random.default_rng(s), sf.Runway(length, 45.0), GRASS).touchdown[0] for s in range(30)
        }
        assert drawn <= {0.0, float(pairs)}
        assert pairs in drawn


def test_designators_are_opposite_and_upright():
    field = airfield(number=np.array([12.0, 18.0, 18.0]), touchdown=np.zeros(2), aiming=np.zeros(4))
    assert not np.array_equal(field.digits[0], field.digits[1])
    begin = field.bars[0] + field.bars[1] + 12.0
    x, y = np.meshgrid(begin + np.arange(0.2, 18, 0.375), np.arange(8.8, -9.0, -0.375), indexing="ij")
    seen = painted(field, x, y).reshape(x.shape)[::-1]  # top of the figures farthest away, left is left
    mask = field.digits[0] > 0.6
    assert np.mean(seen == mask[:, : seen.shape[1]]) > 0.97


def test_away_is_the_distance_from_the_grounds():
    field = airfield(grounds=np.array([100.0, 200.0, 0, 0, 0, 1.0]))
    points = np.array([[1000.0, 99.0], [1000.0, 150.0], [-230.0, 140.0], [2200.0, 0.0], [2300.0, 0.0]])
    out = np.empty(5)
    _away(record(field), points, out)
    np.testing.assert_allclose(out, [0, 50, 50, 0, 100])
    crossing = field._replace(other=np.array([1000.0, -1500.0, 0.0, 1.0, 3000.0, 30.0]))
    _away(
        record(crossing),
        np.array([[1000.0, 900.0], [1000.0, -1600.0], [1150.0, 900.0], [-230.0, 140.0], [0, 0.0]]),
        out,
    )
    np.testing.assert_allclose(out, [0, 40, 60, 50, 0])


@pytest.mark.parametrize(("angle", "white"), [(2.3, 0), (2.7, 1), (3.0, 2), (3.3, 3), (3.7, 4)])
def test_the_papi_shows_the_angle(angle, white):
    field = airfield(lit=np.array([60.0, 0.0, 0.0, 300.0]))
    position = np.array([-3000.0, 0.0, 0.5 + 3300.0 * np.tan(np.radians(angle))])
    units = lights(field, position)[-4:]
    assert int((units[:, 4] > 0.5).sum()) == white
    assert (units[:, 1] > field.width / 2 + 10).all()  # on the left


def test_lights_stand_as_annex_14_spaces_them():
    field = airfield(lit=np.array([60.0, 900.0, 5.0, 300.0]))
    rows = lights(field, np.array([-3000.0, 0.0, 150.0]))
    edge = rows[(rows[:, 1] == field.width / 2 + 1.5) & (rows[:, 0] >= 0) & (rows[:, 6] == 1.0)]
    assert np.diff(edge[:, 0]).max() <= 60.1
    assert rows[:, 0].min() == -900.0
    green = rows[(rows[:, 4] == 1.0) & (rows[:, 3] < 0.5)]
    np.testing.assert_allclose(green[:, 0], -1.0)


def test_lights_shine_where_they_stand():
    field = airfield(lit=np.array([60.0, 0.0, 0.0, 0.0]))
    pose = sf.Pose.from_attitude([-900, 20, 60], 1.0, -4.0, 3.0)
    picture = np.zeros((600, 800, 3), np.float32)
    add_lights(picture, field, CAMERA, pose, 0.5, 20000.0)
    row = lights(field, pose.position_m)
    nearest = row[row[:, 0] == 0.0][0]  # the first edge light, away from the others
    u, v = sf.project(CAMERA, pose, nearest[None, :3])[0]
    left, top = round(u) - 6, round(v) - 6
    patch = picture[top : top + 13, left : left + 13].sum(axis=2)
    assert patch.max() > 10
    rows, columns = np.mgrid[top : top + 13, left : left + 13]
    near = np.hypot(columns - u, rows - v) < 2.5
    centre = [
        float((columns[near] * patch[near]).sum() / patch[near].sum()),
        float((rows[near] * patch[near]).sum() / patch[near].sum()),
    ]
    np.testing.assert_allclose(centre, [u, v], atol=0.4)  # the mask is cut at whole pixels
    day = np.zeros_like(picture)
    add_lights(day, field, CAMERA, pose, 0.0, 20000.0)
    assert day.sum() < 0.05 * picture.sum()
