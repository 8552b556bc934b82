from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_comparison import make_playback
from PIL import Image

from lodestone.report.animation import LINE, STRIP, write_gif


def read(path: Path) -> tuple[list[np.ndarray], list[int]]:
    frames, durations = [], []
    with Image.open(path) as gif:
        for number in range(gif.n_frames):
            gif.seek(number)
            frames.append(np.asarray(gif.convert("RGB")).astype(int))
            durations.append(gif.info["duration"])
    return frames, durations


def test_one_frame_before_each_step_and_one_at_the_end(tmp_path: Path) -> None:
    playback = make_playback()
    write_gif(playback, tmp_path / "episode.gif")
    frames, durations = read(tmp_path / "episode.gif")
    assert len(frames) == len(playback.option) + 1
    assert durations[-1] > 3 * durations[0]
    assert (tmp_path / "episode.gif").stat().st_size < 30_000 * len(frames)
    height, width = playback.pictures.shape[1:3]
    assert frames[0].shape == (height + STRIP, width, 3)
    for frame, picture in zip(frames, playback.pictures, strict=True):
        assert np.abs(frame[:height] - picture).mean() < 2.0  # a palette of 256 colours
    strips = {frame[height:].tobytes() for frame in frames}
    assert len(strips) == len(frames)


def test_small_pictures_are_enlarged(tmp_path: Path) -> None:
    playback = replace(make_playback(), pictures=make_playback().pictures[:, :12, :9])
    write_gif(playback, tmp_path / "episode.gif")
    frames, _ = read(tmp_path / "episode.gif")
    assert frames[0].shape == (12 * 40 + STRIP, 360, 3)


@pytest.mark.parametrize("name", ["x" * 500, "", "<i>\n", "магнит"])
def test_any_name_fits(tmp_path: Path, name: str) -> None:
    whole = make_playback()
    short = replace(
        whole,
        option_names=tuple(name for _ in whole.option_names),
        action_names=tuple(name for _ in whole.action_names),
        pictures=whole.pictures[:3],
        option=whole.option[:2],
    )
    write_gif(short, tmp_path / "episode.gif")
    assert len(read(tmp_path / "episode.gif")[0]) == 3


def test_a_line_says_what_is_planned(tmp_path: Path) -> None:
    whole = make_playback()
    planning = replace(whole, ahead=("up",) * len(whole.option), pictures=whole.pictures[:3], option=whole.option[:2])
    write_gif(planning, tmp_path / "episode.gif")
    frames, _ = read(tmp_path / "episode.gif")
    assert frames[0].shape[0] == whole.pictures.shape[1] + STRIP + LINE
    assert frames[0][-LINE:].min() < 128  # something is written there
