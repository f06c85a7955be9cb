"""The images of one track, also as they are written into a folder: each is located once and kept as its track needs."""

from __future__ import annotations

import hashlib
import os
import time
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack.applications.tracking.explanations import WINDOW
from startrack.applications.tracking.observed_frame import (
    FrameStore,
    ObservedFrame,
    facts_of,
    observe_again,
    observe_frame,
)
from startrack.applications.tracking.odometry import SPAN_TOLERANCE_S, Odometry, odometry_moves, times_s
from startrack.applications.tracking.positions import OnlineTrack, place_modes
from startrack.applications.tracking.track import Track, estimate_track, track_of_newest
from startrack.applications.tracking.track_errors import TrackErrors
from startrack.catalog import load_catalog
from startrack.chain import Located, Settings, input_hashes, job_sha256, load_camera_input, locate, terrain_input
from startrack.core.errors import BadInput
from startrack.estimation.observations import USUAL_ODOMETRY, OdometryErrors
from startrack.exposure import NO_TIME, sidecar_of

if TYPE_CHECKING:
    from startrack.camera import Camera
    from startrack.core.types import Exposure
    from startrack.terrain import Terrain

# Since the last change of a file or its sidecar: it is complete, and one that cannot be read is refused.
TRIES_S = (0.1, 5.0)
POLLING_PART = 0.02  # of a core, to look for images while none comes


@dataclass
class TrackSession:
    """A track that grows image by image. Camera and terrain are those of its first image; all must have them.

    Where an image shows a gross error of a fact that no file states, that error is one of those that the images share;
    the others are observed anew from their evidence.
    """

    store: FrameStore | None = None  # None: frames are kept in memory alone
    settings: Settings = field(default_factory=Settings)
    facts: dict[str, Any] = field(default_factory=dict)  # from flags, by the parameters of `read_exposure`
    stated_camera: str | Camera | None = None  # of all images; None: that which each names
    stated_terrain: str | Terrain | None = None  # the same
    odometry_errors: OdometryErrors = USUAL_ODOMETRY
    frames: list[ObservedFrame] = field(default_factory=list)  # in the order of time
    terrain: Terrain | None = None
    camera: Camera | None = None
    shared: TrackErrors | None = None
    _references: tuple[Any, Any] | None = None  # camera and terrain as the first image has them
    _steepness_1: float | None = None  # of the terrain, from which the errors of all images are counted
    _filtered: int = 0  # number of frames that the filter has
    _online: OnlineTrack | None = None

    def add_exposure(self, exposure: Exposure, path: str | None = None) -> ObservedFrame:
        """The frame of an `exposure`, located unless the store has it; `path` (None: not from a file) is its file's.

        Raises BadInput where the image, its time, camera or terrain cannot be used, or the terrain is another one.
        """
        if exposure.time_utc is None:
            raise BadInput("no_time", "; ".join([NO_TIME, *exposure.warnings]))
        camera, terrain, shared = self._load_references(exposure)
        place = bisect_left(self.frames, exposure.time_utc, key=attrgetter("time_utc"))
        if place < len(self.frames) and self.frames[place].time_utc == exposure.time_utc:
            same = self.frames[place].name  # its evidence would count twice
            raise BadInput("bad_image", f"{exposure.name} has the time of {same}: a track takes an image once")
        key = "" if self.store is None or path is None else self._key(exposure, path, shared)
        frame = self.store.read(key) if self.store and key else None
        if frame is None:
            outcome = locate(exposure, camera, terrain, load_catalog(), self.settings)
            ground = terrain
            if isinstance(outcome, Located):
                ground = self._count_from(terrain, outcome.terrain.errors.steepness_1)
            frame = observe_frame(outcome, replace(shared, gross=facts_of(outcome, shared)), ground)
            if self.store and key:
                self.store.write(key, frame)
        ground = self._count_from(terrain, frame.steepness_1) if frame.modes else terrain
        together = shared.with_gross(frame.facts)
        if together.gross != shared.gross:
            self.frames = [observe_again(one, together, ground) for one in self.frames]
            self.shared = together
        if together.gross != shared.gross or place < self._filtered:
            self._filtered, self._online = 0, None
        frame = frame if frame.facts == together.gross else observe_again(frame, together, ground)
        self.frames.insert(place, frame)
        return frame

    def _count_from(self, terrain: Terrain, steepness_1: float) -> Terrain:
        """The terrain with its errors counted from the steepness of the first image with a position, if not known."""
        self._steepness_1 = self._steepness_1 or steepness_1
        return terrain.with_steepness(self._steepness_1)

    def estimate(self, odometry: Odometry | None = None, *, at_rest: bool = False, covered_only: bool = False) -> Track:
        """The track of the frames so far; `odometry` and `at_rest` are those of `estimate_track`.

        With `covered_only`, frames after the last pose of the odometry wait for it. Raises BadInput where there is no
        frame, or none has a position, and as `estimate_track`.
        """
        frames = [one for one in self.frames if not covered_only or _is_reached(one, odometry)]
        if self.terrain is None or self.shared is None or not frames:
            raise BadInput("bad_image", "no image of the track could be read")
        if all(len(frame.modes) != 1 for frame in frames):
            refused = next((frame for frame in frames if not frame.modes), None)
            reason = "insufficient_geometry" if refused is None else refused.reason
            raise BadInput(reason, f"none of {len(frames)} images has a single position")
        return estimate_track(
            frames, self.terrain, self.shared, odometry=odometry, odometry_errors=self.odometry_errors, at_rest=at_rest,
        )  # fmt: skip

    @property
    def waits(self) -> bool:
        """Whether frames were not filtered yet."""
        return self._filtered < len(self.frames)

    def newest(self, odometry: Odometry | None, *, has_ended: bool = False) -> Iterator[Track]:
        """Tracks of one frame each: of every one not filtered yet that the `odometry` reaches, by the frames up to it.

        `has_ended`: also of frames after its last pose, which no odometry reaches any more. If a frame comes late, all
        frames after it are filtered anew. Raises as `estimate`.
        """
        terrain, shared = self.terrain, self.shared
        if terrain is None or shared is None:
            return
        for k in range(self._filtered, len(self.frames)):
            if not (has_ended or _is_reached(self.frames[k], odometry)):
                return
            online = self._online = self._filter_to(k, odometry, shared)
            self._filtered += 1
            is_outside = odometry is not None and not odometry.covers(times_s(self.frames[k : k + 1]))[0]
            yield track_of_newest(self.frames[k], online, terrain, is_outside=is_outside)

    def _filter_to(self, k: int, odometry: Odometry | None, shared: TrackErrors) -> OnlineTrack:
        """The filter with frame k; where positions are not linear in `shared`, of all frames about what they show."""
        online = self._online
        if online is None or shared.bends:
            online = OnlineTrack(len(shared), WINDOW)
        first = online.first
        frames = self.frames[first : k + 1]
        moves = odometry_moves(frames, odometry, self.odometry_errors, shows_scale=not shared.bends)
        added = frames if shared.bends else frames[-1:]
        for of in place_modes([frame.modes for frame in added], moves, shared):
            online.add(of, moves, first)
        return online

    def _load_references(self, exposure: Exposure) -> tuple[Camera, Terrain, TrackErrors]:
        """Camera, terrain and shared errors of the track: those of its first image. Raises BadInput for another's."""
        camera = exposure.camera if self.stated_camera is None else self.stated_camera
        terrain = exposure.terrain if self.stated_terrain is None else self.stated_terrain
        if camera is None:
            raise BadInput("no_calibration", "no camera is known: give -c FILE (camera=) or a sidecar with camera")
        if terrain is None:
            raise BadInput("bad_terrain", "no terrain is known: give -t FILE (terrain=) or a sidecar with terrain")
        if self.camera is None or self.terrain is None or self.shared is None:
            lens, ground = load_camera_input(camera), terrain_input(terrain, None)
            self.shared = TrackErrors.of_exposure(ground, exposure, self.settings.evidence_sources != "stars")
            self.camera, self.terrain, self._references = lens, ground, (camera, terrain)
        first_camera, first_terrain = self._references or (None, None)
        if terrain is not first_terrain and terrain != first_terrain:
            raise BadInput("bad_terrain", f"{exposure.name} is on the terrain {terrain}, the track on {first_terrain}")
        if camera is not first_camera and camera != first_camera:
            raise BadInput("bad_calibration", f"{exposure.name} is of the camera {camera}, the track of {first_camera}")
        return self.camera, self.terrain, self.shared

    def _key(self, exposure: Exposure, path: str, shared: TrackErrors) -> str:
        """Hash of all that decides a frame."""
        files = input_hashes(path, [exposure.camera], exposure.terrain, exposure.mask, exposure.obstacles)
        alone = replace(shared, gross=frozenset())  # with the facts that the image itself shows
        clock = None if shared.listed.clock is None else shared.listed.clock.turn_rad_s.tolist()
        errors = [repr((shared.listed.listed, shared.listed.waves)), alone.names, alone.sigma.tolist(), clock]
        others = self.settings.evidence_sources, self.settings.near_attitude, sorted(files.items()), errors
        job = job_sha256(path, exposure.sha256, self.facts, *others)
        return hashlib.sha256(f"{exposure.name} {job}".encode()).hexdigest()[:32]


def _is_reached(frame: ObservedFrame, odometry: Odometry | None) -> bool:
    """Whether the odometry has come as far as the frame."""
    last_s = np.inf if odometry is None else float(odometry.time_s[-1])
    return bool(times_s([frame])[0] <= last_s + SPAN_TOLERANCE_S)


def follow_images(
    list_images: Callable[[], Iterable[str]],
    take: Callable[[str], None],
    refuse: Callable[[str, BadInput], None],
    *,
    until_idle_s: float | None,
) -> Iterator[str | None]:
    """Give each path that `list_images` has listed to `take`, and yield it after that; None where no image waits.

    An image waits until size and time of its file and of its sidecar stay as they are; these times are compared with
    each other, not with a clock. One that `take` refuses with BadInput is tried again when one of them changes, and
    once after some seconds; then `refuse` gets it. Ends when no image came for `until_idle_s` (None: never).
    """
    taken: set[str] = set()
    waiting: dict[str, _Waiting] = {}
    idle_since = time.monotonic()
    while True:
        start_s, has_come = time.process_time(), False
        waiting |= {path: _Waiting() for path in list_images() if path not in taken and path not in waiting}
        for path, one in sorted(waiting.items()):
            stamp, now = _stamp(path), time.monotonic()
            if stamp is None:  # removed since it was listed
                del waiting[path]
                continue
            if stamp != one.stamp:
                one.stamp, one.since, one.tries = stamp, now, 0
            if one.tries < len(TRIES_S):  # neither taken nor refused
                idle_since = now
            if one.tries == len(TRIES_S) or now - one.since < TRIES_S[one.tries]:
                continue
            one.tries += 1
            before_s = time.process_time()
            try:
                take(path)
            except BadInput as cause:
                if one.tries == len(TRIES_S):
                    refuse(path, cause)
                continue
            finally:  # is no part of looking for images
                start_s += time.process_time() - before_s
            taken.add(path)
            del waiting[path]
            has_come = True
            yield path
            idle_since = time.monotonic()
        if has_come:
            continue
        looked_s = time.process_time() - start_s
        yield None
        if until_idle_s is not None and time.monotonic() - idle_since > until_idle_s:
            return
        time.sleep(max(0.5 * TRIES_S[0], looked_s / POLLING_PART))


@dataclass(eq=False)
class _Waiting:
    """A file that was not taken yet."""

    stamp: object = None
    since: float = 0.0  # when that was seen first
    tries: int = 0


def _stamp(path: str) -> object:
    """Size and time of a file and of its sidecar; None where there is no file."""
    try:
        stats = [os.stat(one) for one in (path, sidecar_of(Path(path))) if one is not None]
    except OSError:
        return None
    return [(one.st_size, one.st_mtime_ns) for one in stats]
