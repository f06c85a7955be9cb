"""The limit of processor time: what it refuses and states; without it nothing changes."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest

from startrack.catalog import load_catalog
from startrack.chain import Located, Refused, Settings, identify_blind, locate_exposure
from startrack.chain.stages import Measured
from startrack.cli.main import main
from startrack.core import limits
from startrack.core.errors import Reason
from startrack.core.limits import TimeLimitReached, check_time, limited_time, stating_work, uncounted_time
from startrack.core.runner import map_in_threads
from startrack.exposure import exposure_of, read_exposure

SAMPLES = Path(__file__).parents[1] / "sample_images"
LOWELL = str(SAMPLES / "lowell-2018-08-06.fits.bz2")


class StepClock(limits._Clock):
    """A clock that goes on by one second with every question, so that a limit counts questions."""

    now = 0.0

    def now_s(self) -> float:
        self.now += 1.0
        return self.now


@pytest.fixture
def questions(monkeypatch: pytest.MonkeyPatch) -> StepClock:
    clock = StepClock()
    monkeypatch.setattr(limits, "CLOCK", clock)
    return clock


def points(count: int, seed: int = 1) -> np.ndarray:
    """A picture with so many point sources that are no stars."""
    rng = np.random.default_rng(seed)
    image, (row, column) = rng.normal(1000.0, 10.0, (400, 400)), np.mgrid[-6:7, -6:7]
    for x, y in rng.integers(10, 390, (count, 2)):
        image[y - 6 : y + 7, x - 6 : x + 7] += rng.uniform(300, 3000) * np.exp(-(row**2 + column**2) / 3.0)
    return image.round().astype(np.uint16)


def work(seconds: float) -> None:
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


def test_the_limit_is_of_processor_time() -> None:
    check_time()
    with limited_time(0.05):
        time.sleep(0.1)
        check_time()
        work(0.06)
        with pytest.raises(TimeLimitReached, match=r"the limit of 0\.05 s of processor time"):
            check_time()
    check_time()
    with pytest.raises(ValueError, match="above 0"), limited_time(0.0):
        pass


def test_what_is_made_once_does_not_count() -> None:
    """Also of blocks that overlap, as those of two threads do."""
    with limited_time(0.05):
        with uncounted_time():
            with uncounted_time():
                work(0.04)
            work(0.04)
            check_time()
        check_time()


def test_a_limit_holds_in_threads_and_inner_blocks() -> None:
    with limited_time(1e-9):
        work(1e-3)
        with limited_time(None), pytest.raises(TimeLimitReached):
            check_time()
        with pytest.raises(TimeLimitReached):
            list(map_in_threads(abs, [1, 2, 3]))
    assert list(map_in_threads(abs, [-1, 2])) == [1, 2]


def test_the_work_done_is_stated() -> None:
    def search() -> None:
        with stating_work(lambda: "stage identify"), stating_work(lambda: "3 patterns tried"), limited_time(1e-9):
            work(1e-3)
            check_time()

    with pytest.raises(TimeLimitReached, match=r"before an answer; 3 patterns tried; stage identify$"):
        search()


def test_an_exception_that_is_caught_inside_keeps_its_message() -> None:
    first = TimeLimitReached("it came")
    with pytest.raises(TimeLimitReached, match=r"^it came; 3 tried$") as caught, stating_work(lambda: "3 tried"):
        raise first
    assert str(first) == "it came" and caught.value.__cause__ is first


@pytest.mark.parametrize("asked", [3, 20])
def test_a_refused_search_states_what_it_saw_and_tried(questions: StepClock, asked: int) -> None:
    """In detection, and among the patterns."""
    image = points(60)
    settings = Settings(time_limit_s=asked)
    outcome = identify_blind(exposure_of(image), (np.radians(30.0), np.radians(60.0)), load_catalog(), settings)
    assert isinstance(outcome, Refused) and outcome.reason is Reason.TIME_LIMIT
    assert questions.now < asked + 3
    is_among_patterns = "at the stage identify" in outcome.message
    assert is_among_patterns == (asked == 20)
    for text in ("58 point sources", "patterns of the", "in 400 x 400 px"):
        assert (text in outcome.message) == is_among_patterns, outcome.message


@pytest.mark.parametrize(
    ("command", "seconds", "solved"),
    [("identify", "1e-3", False), ("locate", "1e-3", False), ("identify", "1e3", True)],
)
def test_an_image_with_a_limit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, seconds: str, solved: bool
) -> None:
    image = str(SAMPLES / "near-wall.png")
    words = [command, image, "-D", str(tmp_path), "--no-plots", "--json", "--time-limit", seconds]
    assert main(words) == (0 if solved else 3)
    found = json.loads(capsys.readouterr().out)
    assert found["reason"] == (None if solved else "time_limit")
    if not solved:
        assert "--time-limit" in found["advice"]
        assert "processor time" in found["message"]


def test_a_position_is_not_given_before_its_checks(questions: StepClock) -> None:
    """A limit that comes just before the end leaves the attitude; one just after the end leaves the answer."""
    exposure = read_exposure(SAMPLES / "near-wall.png")
    whole = locate_exposure(exposure, Settings(time_limit_s=1e9))
    assert isinstance(whole, Located)
    asked, questions.now = questions.now, 0.0
    late = locate_exposure(exposure, Settings(time_limit_s=asked - 4))
    assert isinstance(late, Refused) and late.reason is Reason.TIME_LIMIT and "stage locate" in late.message
    assert isinstance(late.reached, Measured) and not isinstance(late.reached, Located)
    np.testing.assert_array_equal(late.reached.R_cam_enu, whole.R_cam_enu)
    questions.now = 0.0
    assert isinstance(locate_exposure(exposure, Settings(time_limit_s=asked + 1)), Located)


@pytest.mark.parametrize(
    "words",
    [
        ["calibrate", LOWELL, "--fov", "180", "-o", "{0}/camera.toml"],
        ["horizon", LOWELL, "--fov", "180", "--site=34.7443,-111.4223,2361", "-o", "{0}/h.csv"],
    ],
    ids=["calibrate", "horizon"],
)
def test_a_command_with_a_limit_writes_no_result(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    flags = ["--json", "--time-limit", "0.05"]
    assert main([*(word.format(tmp_path) for word in words), *flags]) == 3
    assert json.loads(capsys.readouterr().out)["reason"] == "time_limit"
    assert not (tmp_path / "camera.toml").exists() and not (tmp_path / "h.csv").exists()


@pytest.mark.parametrize("seconds", ["0", "-1", "soon"])
def test_a_limit_is_a_time(seconds: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["identify", "a.png", "--time-limit", seconds])
    assert end.value.code == 2 and "--time-limit" in capsys.readouterr().err
