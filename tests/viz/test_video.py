"""Films, decoded again: their form, and that marks are where the tracks are, in the color of their error."""

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from synthetic import ENTITIES, LOOKING_ALONG_Y, make_episode, make_filmed_episode

from flowlab.errors import DataError
from flowlab.records import Episode, Role
from flowlab.viz.caption_bar import CaptionBar
from flowlab.viz.colors import ROLE_RGB
from flowlab.viz.overlay import Overlay
from flowlab.viz.stated_error import SIGMA_RGB, describe_shares, is_coarse, percent, shares_below, sigma_rgb
from flowlab.viz.video import write_video

SCALE = 8  # 80 pixels wide becomes 640
GRAY = (128, 128, 128)
GOOD, _, _, MIDDLE, BAD = (np.array(rgb, float) for rgb in SIGMA_RGB)


@pytest.fixture(scope="module")
def episode() -> Episode:
    return make_filmed_episode()


def decoded(path: Path) -> np.ndarray:
    """All frames (T, H, W, 3)."""
    with av.open(str(path)) as film:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]).astype(float)


def filmed(episode: Episode, folder: Path, **options: object) -> np.ndarray:
    write_video(episode, folder / "e.mp4", **options)  # type: ignore[arg-type]
    return decoded(folder / "e.mp4")


@pytest.fixture(scope="module")
def film(episode: Episode, tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    return filmed(episode, tmp_path_factory.mktemp("film"), trail_s=0.3)


def center(u: float, v: float) -> tuple[float, float]:
    """Row and column in the film of the center of a pixel of the picture."""
    return (v + 0.5) * SCALE - 0.5, (u + 0.5) * SCALE - 0.5


def color(picture: np.ndarray, row: float, column: float) -> np.ndarray:
    """Mean of the 3 x 3 pixels there: H.264 halves the resolution of color."""
    r, c = round(row), round(column)
    return picture[r - 1 : r + 2, c - 1 : c + 2].mean((0, 1))


def shows(picture: np.ndarray, row: float, column: float, expected: object, tolerance: float = 25) -> bool:
    return bool(np.abs(color(picture, row, column) - expected).max() < tolerance)


def middle_of(picture: np.ndarray, expected: np.ndarray, row: float, column: float) -> np.ndarray:
    """Offset (rows, columns) of the mean of all pixels of a color near a place."""
    r, c = round(row), round(column)
    near = np.abs(picture[r - 9 : r + 10, c - 9 : c + 10] - expected).max(-1) < 40
    return np.argwhere(near).mean(0) - 9 + [r - row, c - column]


def test_a_film_has_the_form_that_browsers_play(episode: Episode, tmp_path: Path) -> None:
    write_video(episode, tmp_path / "e.mp4")
    with av.open(str(tmp_path / "e.mp4")) as film:
        stream = film.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")
        assert stream.average_rate == Fraction(10)
        assert stream.frames == len(episode)
        assert (stream.width, stream.height) == (640, 598)
        assert float(stream.duration * stream.time_base) == pytest.approx(1.2)
    content = (tmp_path / "e.mp4").read_bytes()
    assert 0 < content.find(b"moov") < content.find(b"mdat")  # so that it plays before it has all arrived


def test_frames_come_at_the_mean_rate_or_as_asked(episode: Episode, tmp_path: Path) -> None:
    uneven = replace(episode, time_s=np.cumsum(np.tile([0.02, 0.06], 6)))  # 11 steps in 0.46 s
    for fps, expected in ((None, 11 / 0.46), (25.0, 25.0)):
        write_video(uneven, tmp_path / "e.mp4", fps=fps)
        with av.open(str(tmp_path / "e.mp4")) as film:
            assert float(film.streams.video[0].average_rate) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("t", [0, 5, 11])
def test_discs_move_with_their_points(film: np.ndarray, t: int) -> None:
    for expected, u, v in ((GOOD, 20 + t, 12), (BAD, 60, 10 + t)):
        assert shows(film[t], *center(u, v), expected)
        assert np.abs(middle_of(film[t], expected, *center(u, v))).max() < 2  # the trail's first pixels count too
        ahead = (u + 1.5, v) if expected is GOOD else (u, v + 1.5)
        assert shows(film[t], *center(*ahead), GRAY)


def test_colors_are_coded_as_the_film_says(episode: Episode, tmp_path: Path) -> None:
    write_video(episode, tmp_path / "e.mp4")
    with av.open(str(tmp_path / "e.mp4")) as film:
        frame = next(film.decode(video=0))
    assert (frame.colorspace, frame.color_range) == (1, 1)  # BT.709, limited: 16 is black and 235 white
    row, column = map(round, center(60, 10))
    luma = 16 + 219 / 255 * (BAD @ [0.2126, 0.7152, 0.0722])
    assert abs(int(frame.to_ndarray(format="yuv420p")[row, column]) - luma) < 5  # by BT.601 it would be 16 more


def test_trails_show_the_last_steps_and_fade(film: np.ndarray) -> None:
    def strength(steps_ago: float) -> float:  # of the trail that ends at u = 31
        return float(np.abs(color(film[11], *center(31 - steps_ago, 12)) - GRAY).max())

    assert strength(1.5) > strength(2.5) > 10
    assert strength(4) < 10


def test_marks_tell_what_is_in_sight_out_of_sight_and_filled_in(film: np.ndarray) -> None:
    picture = film[6]
    filled, hidden = center(30, 40), center(50, 45)
    ring = [color(picture, hidden[0] + r, hidden[1] + c) for r, c in ((-4, 0), (4, 0), (0, -4), (0, 4))]
    assert min(pixel[0] - pixel[2] for pixel in ring) > 60  # yellow, if dim
    inside = color(picture, *hidden)
    assert inside[0] - inside[2] < 40  # a little of the ring's color runs into it
    assert inside.max() < 160
    cross, between = [
        np.mean([picture[round(filled[0] + r * a), round(filled[1] + c * b)] for a in (-1, 1) for b in (-1, 1)], 0)
        for r, c in ((2, 2), (5, 0))
    ]
    assert cross[0] - cross[2] > 40
    assert np.abs(between - GRAY).max() < 25


def test_padding_and_what_is_behind_the_camera_leave_no_mark(film: np.ndarray) -> None:
    for place in ((70, 52), (40, 30), (39, 29)):
        assert shows(film[6], *center(*place), GRAY, 8)


def test_exact_tracks_are_colored_by_role(tmp_path: Path) -> None:
    filmed_episode = make_filmed_episode()
    exact = replace(
        filmed_episode,
        tracks=replace(filmed_episode.tracks, quality=None),
        queries=replace(filmed_episode.queries, owner=np.array([0, 1, 0, 1, 0, 0], np.int16), entities=ENTITIES),
    )
    film = filmed(exact, tmp_path)
    assert shows(film[4], *center(24, 12), ROLE_RGB[Role.PROP])
    assert shows(film[4], *center(60, 14), ROLE_RGB[Role.OBJECT])


def test_stated_errors_have_the_same_classes_everywhere() -> None:
    sigma = np.array([0, 0.0049, 0.005, 0.012, 0.02, 0.049, 0.05, 0.4, np.inf, np.nan], np.float32)
    expected = [0, 0, 1, 2, 3, 3, 4, 4, 4, 4]
    np.testing.assert_array_equal(sigma_rgb(sigma), np.array(SIGMA_RGB)[expected])
    np.testing.assert_array_equal(is_coarse(sigma), np.array(expected) >= 3)
    np.testing.assert_allclose(shares_below(sigma), [0.2, 0.3, 0.4, 0.6, 0.4])
    assert [percent(share) for share in (0, 1e-3, 0.006, 0.5, 0.994, 0.999, 1)] == [
        "0%", "<1%", "1%", "50%", "99%", ">99%", "100%",
    ]  # fmt: skip
    assert describe_shares(sigma) == "σ < 5 mm 20%, < 10 mm 30%, < 20 mm 40%, < 50 mm 60%"


def oklab(linear_rgb: np.ndarray) -> np.ndarray:
    """Colors in Ottosson's space, where equal distances look equal; lightness first."""
    to_lms = [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
    to_lab = [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
    return np.cbrt(linear_rgb.clip(0, 1) @ np.transpose(to_lms)) @ np.transpose(to_lab)


@pytest.mark.parametrize(
    "seen",  # Machado et al. 2009, severity 1, on linear RGB
    [
        pytest.param(np.eye(3), id="all colors"),
        pytest.param([[0.1523, 1.0526, -0.2049], [0.1145, 0.7863, 0.0992], [-0.0039, -0.0481, 1.052]], id="no red"),
        pytest.param([[0.3673, 0.8606, -0.228], [0.2801, 0.6725, 0.0474], [-0.0118, 0.0429, 0.9689]], id="no green"),
        pytest.param([[1.2555, -0.0767, -0.1788], [-0.0784, 0.9308, 0.1476], [0.0047, 0.6914, 0.3039]], id="no blue"),
    ],
)
def test_color_blind_people_can_tell_the_classes_apart(seen: list[list[float]]) -> None:
    linear = ((np.array(SIGMA_RGB) / 255 + 0.055) / 1.055) ** 2.4
    lab = oklab(linear @ np.transpose(seen))
    assert (np.diff(lab[:, 0]) < -0.03).all(), "the larger the error, the darker"
    distance = np.linalg.norm(lab[:, None] - lab, axis=-1)
    assert distance[~np.eye(len(lab), dtype=bool)].min() > 0.09


def test_a_large_stated_error_is_a_circle_of_its_size_and_makes_trails_faint(episode: Episode, tmp_path: Path) -> None:
    assert episode.tracks.quality is not None
    sigma = episode.tracks.quality.sigma.copy()

    def at_step_8(of_first: float) -> np.ndarray:
        sigma[:, 0] = of_first
        tracks = replace(episode.tracks, quality=replace(episode.tracks.quality, sigma=sigma))
        return filmed(replace(episode, tracks=tracks), tmp_path, trail_s=0.3)[8]

    large, small = at_step_8(0.03), at_step_8(0.019)
    row, column = center(28, 12)
    radius = 0.03 * episode.camera.K[0, 0] * SCALE  # 1 m away
    for picture, rim in ((large, True), (small, False)):
        strongest = np.abs(picture[round(row - radius) - 2 : round(row - radius) + 3, round(column)] - GRAY).max()
        assert (strongest > 40) == rim
    trail = row, column - 1.6 * SCALE
    assert np.abs(color(small, *trail) - GRAY).max() > 1.5 * np.abs(color(large, *trail) - GRAY).max()


def test_without_color_the_depth_is_shown_in_gray(episode: Episode, tmp_path: Path) -> None:
    assert episode.depth is not None
    depth = episode.depth.copy()
    depth[:, :, 40:] = 2.0
    depth[:, 50:] = 0
    film = filmed(replace(episode, rgb=None, depth=depth), tmp_path)
    near, far, nothing = (color(film[0], *center(*place)) for place in ((5, 25), (75, 25), (5, 56)))
    assert near.mean() > far.mean() + 100 > nothing.mean() + 130
    assert nothing.max() < 8
    assert np.ptp(near) < 6
    assert shows(film[4], *center(24, 12), GOOD)


def test_an_episode_without_pictures_is_one_sentence(episode: Episode, tmp_path: Path) -> None:
    for bare, how in ((episode, "--set write.rgb=true"), (make_episode(), "--renderer gl")):
        with pytest.raises(DataError, match=rf"{bare.task}, seed {bare.seed}: .* {how}") as error:
            write_video(replace(bare, rgb=None, depth=None), tmp_path / "e.mp4")
        assert "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_what_a_hanging_camera_films_is_turned_upright(tmp_path: Path) -> None:
    upright = make_filmed_episode(LOOKING_ALONG_Y)
    assert upright.rgb is not None
    upright.rgb[:, :10, :10] = 250
    turned = LOOKING_ALONG_Y @ np.diag([-1.0, -1, 1, 1])
    hanging = replace(upright, rgb=upright.rgb[:, ::-1, ::-1], camera=replace(upright.camera, T_world_cam=turned))
    np.testing.assert_allclose(filmed(hanging, tmp_path), filmed(upright, tmp_path), atol=1)


@pytest.mark.parametrize(("width", "height", "expected"), [(641, 481, (642, 598)), (1280, 720, (1280, 954))])
def test_wide_pictures_keep_their_size_and_odd_ones_become_even(
    width: int, height: int, expected: tuple[int, int], tmp_path: Path
) -> None:
    episode = make_filmed_episode(steps=2)
    camera = replace(episode.camera, width=width, height=height)
    rgb = np.full((2, height, width, 3), 90, np.uint8)
    film = filmed(replace(episode, camera=camera, rgb=rgb, depth=None), tmp_path)
    assert film.shape[2:0:-1] == expected
    empty = film[:, height // 2 : height - 4, width // 2 : width - 4]  # all points are upper left
    assert np.abs(empty - 90).max() < 8


def test_one_frame_is_enough(episode: Episode, tmp_path: Path) -> None:
    names = ["time_s", "point_cloud", "point_count", "state", "action", "success", "rgb", "depth"]
    known = episode.tracks.quality
    first = {k: values[:1] for k in known.__slots__ if (values := getattr(known, k)) is not None}
    quality = replace(known, **first)
    tracks = replace(
        episode.tracks, xyz_world=episode.tracks.xyz_world[:1], visible=episode.tracks.visible[:1], quality=quality
    )
    one = replace(episode, tracks=tracks, **{name: getattr(episode, name)[:1] for name in names})
    film = filmed(one, tmp_path)
    assert len(film) == 1
    assert shows(film[0], *center(20, 12), GOOD)


def test_points_far_outside_do_no_harm(episode: Episode, tmp_path: Path) -> None:
    wild = episode.tracks.xyz_world.copy()
    wild[3:6, 1] = [[1e9, 0, 1], [0, 0, 0], [0.1, -1e30, 1e-20]]
    lost = replace(episode, tracks=replace(episode.tracks, xyz_world=wild))
    film = filmed(lost, tmp_path)
    assert shows(film[4], *center(60, 14), GRAY, 8)
    assert shows(film[8], *center(60, 18), BAD)


def test_the_strip_says_whose_film_it_is_and_how_far(episode: Episode, film: np.ndarray, tmp_path: Path) -> None:
    noted = filmed(episode, tmp_path, trail_s=0.3, title="another", note="rejected at quality: " + "too poor " * 15)
    assert noted.shape[1] == film.shape[1] + 2 * 18
    red = (noted[5, 597:, :, 0] - noted[5, 597:, :, 2] > 30).sum()
    assert red > 300
    title = np.s_[500:525, :300]
    assert np.abs(noted[5][title] - film[5][title]).max() > 100
    shares = film[5, 480:494]  # of five points one is below 5 mm, three are below 50
    for y, expected in ((12, GOOD), (6, MIDDLE), (1, BAD)):
        assert np.abs(shares[y, 100] - expected).max() < 40
        assert shares[y, 500].max() < 0.5 * shares[y, 100].max()
    for k, expected in enumerate(SIGMA_RGB):
        assert shows(film[0], 582, 108 + 107 * k, expected, 40)


def test_the_strip_of_exact_tracks_says_so(episode: Episode) -> None:
    exact = replace(episode, tracks=replace(episode.tracks, quality=None))
    assert CaptionBar(exact, 640, "pour", "").draw(0).shape == (84, 640, 3)
    for shown, words in ((exact, "exact tracks"), (episode, "tracker rigid-bodies")):
        texts = [text.get_text() for text in CaptionBar(shown, 640, "pour", "")._figure.texts]
        assert words in texts
        assert ("stated error σ" in texts) == (shown is episode)


def test_a_failure_leaves_the_old_film_alone(episode: Episode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: Overlay, canvas: np.ndarray, t: int) -> None:
        if t == 3:
            raise RuntimeError("half way")

    monkeypatch.setattr(Overlay, "draw", fail)
    (tmp_path / "e.mp4").write_text("old")
    with pytest.raises(RuntimeError, match="half way"):
        write_video(episode, tmp_path / "e.mp4")
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {"e.mp4": "old"}


def test_nothing_is_left_where_the_film_cannot_be_put(episode: Episode, tmp_path: Path) -> None:
    (tmp_path / "e.mp4").mkdir()
    with pytest.raises(DataError, match=r"e\.mp4"):
        write_video(episode, tmp_path / "e.mp4")
    assert [p.name for p in tmp_path.iterdir()] == ["e.mp4"]
