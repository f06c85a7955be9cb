"""One run of `startrack track`: locates images, estimates the track, prints and writes it."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.cli.progress import prepare_reference, progress
from startrack.core.errors import EXIT_BAD_INPUT, EXIT_REFUSED, EXIT_STOPPED, BadInput, exit_code_of

if TYPE_CHECKING:
    from startrack.applications.tracking import ObservedFrame, Odometry, Track, TrackSession
    from startrack.core.types import Exposure

Source = tuple[str, "Callable[[], ObservedFrame]"]  # of one image: its name, and what adds it to the track
QUICK_S = 0.2  # files that take longer are written when no image waits


class OdometryFile:
    """A file of odometry that is read again where it has changed."""

    def __init__(self, path: str, topic: str | None, is_followed: bool) -> None:
        """Of a `path`, and of a bag the `topic`; `is_followed`: its last line may be incomplete."""
        self.path, self.topic, self.is_followed = path, topic, is_followed
        self._has_ended = False
        self._read: tuple[object, Odometry] | None = None  # with the stamp of the file

    @property
    def has_changed(self) -> bool:
        """Whether the file is another one than was read."""
        return self._read is None or self._read[0] != self._stamp()

    def read(self) -> Odometry:
        """The odometry as it is now. Raises BadInput as `read_odometry`."""
        from startrack.applications.tracking import read_odometry

        stamp = self._stamp()
        if self._read is not None and self._read[0] == stamp:
            return self._read[1]
        try:
            moves = read_odometry(self.path, self.topic, growing=self.is_followed and not self._has_ended)
        except BadInput:
            if not self._has_ended:
                raise
            moves = read_odometry(self.path, self.topic, growing=True)  # without the last line
        self._read = stamp, moves
        return moves

    def end(self) -> None:
        """The file grows no more: its last line counts too, if it can be read."""
        self._has_ended, self._read = True, None

    def _stamp(self) -> object:
        with suppress(OSError):
            found = Path(self.path).stat()
            return found.st_size, found.st_mtime_ns
        return None


class TrackRun:
    """One run of the command: what it prints and writes."""

    def __init__(self, args: argparse.Namespace, session: TrackSession) -> None:
        self.args, self.session = args, session
        self.codes: set[int] = set()
        self._is_old, self._write_s = False, 0.0  # the files; what writing them took
        self._printed = 0  # lines at rest
        self._shown: set[str] = set()  # facts whose gross error an image showed
        self._moves: OdometryFile | None = None
        if args.odometry is not None:
            self._moves = OdometryFile(args.odometry, args.odometry_topic, bool(args.follow))

    def take_all(self) -> None:
        """Locate all images, then estimate and write the track."""
        paths = self._paths()
        with progress("track", len(paths or ()), shown=paths is not None and not self.args.quiet) as bar:
            for name, add in self._sources(paths):
                try:
                    self._note(add())
                except BadInput as cause:
                    self._refuse(name, cause)
                bar.advance()
        self._finish()

    def follow(self) -> None:
        """Take images as they come; Ctrl-C and SIGTERM end it, before the first image with the code of a stop."""
        from startrack.applications.batch import images_under
        from startrack.applications.tracking import follow_images

        folder = self.args.frames[0]
        former = signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            for path in follow_images(
                lambda: [image.path for image in images_under(folder, self.args.dir)],
                lambda path: self._note(self._add(path)),
                lambda path, cause: self._refuse(os.path.relpath(path, folder), cause),
                until_idle_s=self.args.until_idle,
            ):
                self._update(path is not None)
        except KeyboardInterrupt:
            if not self.session.frames:
                print("startrack: interrupted before the first image", file=sys.stderr, flush=True)
                self.codes.add(EXIT_STOPPED)
                return
        finally:
            signal.signal(signal.SIGTERM, former)
        if self._moves is not None:
            self._moves.end()
        self._finish(growing=True)

    def _finish(self, growing: bool = False) -> None:
        """Write and print the track of all images, `growing` in front of the user; the reasons where there is none."""
        from startrack.applications.tracking import frame_records, track_record

        try:
            track = self._estimate(growing)
        except BadInput as cause:
            if exit_code_of(cause.reason) == EXIT_BAD_INPUT:
                raise
            for frame in self.session.frames:
                if frame.reason:
                    print(f"{frame.name}  refused  {frame.reason}: {frame.message}", file=sys.stderr, flush=True)
            print(f"startrack: {cause.reason}: {cause}", file=sys.stderr, flush=True)
            self.codes.add(exit_code_of(cause.reason))
            return
        self._write(track)
        if any(frame.status != "used" for frame in track.frames):
            self.codes.add(EXIT_REFUSED)
        if not growing:
            self._print_records(frame_records(track), "")
        if not (self.args.quiet or self.args.json):
            counts = track_record(track)["counts"]
            print(
                f"{counts['frames']} frames: {counts['used']} used, {counts['left_out']} left out, {counts['refused']} "
                f"refused; {counts['slips']} slips of the odometry; files in {self.args.dir}/track.*"
            )

    def _update(self, has_come: bool) -> None:
        """A line about each image that the odometry reaches; the files, unless the next image would wait for them."""
        waits = self._moves is not None and self.session.waits and self._moves.has_changed
        if not (has_come or self._is_old or waits):
            return
        try:
            self._is_old |= self._print_newest()
            if self._is_old and (not has_come or self._write_s < QUICK_S):
                start = time.monotonic()
                self._write(self._estimate(growing=True), pictures=False)
                self._write_s, self._is_old = time.monotonic() - start, False
        except BadInput as cause:  # no position yet, or no odometry for the first images
            if has_come:
                print(f"waiting: {cause}", file=sys.stderr, flush=True)
            self._is_old = False

    def _print_newest(self) -> bool:
        """Print a line about each image that has none yet; whether there was one."""
        from startrack.applications.tracking import frame_records

        if self.args.at_rest:
            before, self._printed = self._printed, len(self.session.frames)
            records = frame_records(self._estimate())[before:]
        else:
            newest = self.session.newest(self._odometry())
            records = [record for track in newest for record in frame_records(track)]
        self._print_records(records, "filtered_")
        return bool(records)

    def _print_records(self, records: Sequence[dict[str, Any]], prefix: str) -> None:
        for record in records:
            if self.args.json:
                print(json.dumps(record), flush=True)
            elif not self.args.quiet:
                print(_line(record, prefix), flush=True)

    def _paths(self) -> list[str] | None:
        """The image files; None for a bag."""
        from startrack.applications.batch import images_under
        from startrack.exposure import is_bag

        first = Path(self.args.frames[0])
        if len(self.args.frames) == 1 and is_bag(first):
            return None
        if not first.is_dir():
            return list(self.args.frames)
        paths = [one.path for one in images_under(first, self.args.dir)]
        if not paths:
            raise BadInput("bad_image", f"{first}: no images in this folder")
        return paths

    def _sources(self, paths: list[str] | None) -> Iterator[Source]:
        """The images of `paths`, or those of the bag."""
        from startrack.applications.tracking import read_bag_exposures

        if paths is not None:
            yield from ((Path(path).name, partial(self._add, path)) for path in paths)
            return
        for exposure in read_bag_exposures(self.args.frames[0], self.args.image_topic, **self.session.facts):
            yield exposure.name, partial(self._add_exposure, exposure)

    def _add(self, path: str) -> ObservedFrame:
        from startrack.exposure import read_exposure

        return self._add_exposure(read_exposure(path, **self.session.facts), path)

    def _add_exposure(self, exposure: Exposure, path: str | None = None) -> ObservedFrame:
        if self.session.terrain is None:
            prepare_reference(exposure.terrain, self.args)
        return self.session.add_exposure(exposure, path)

    def _note(self, frame: ObservedFrame) -> None:
        for one in frame.shown:
            if one.fact not in self._shown:
                self._shown.add(one.fact)
                what = f"the image shows {one.text}, which no file states: the track estimates it"
                print(f"{frame.name}  {what}", file=sys.stderr, flush=True)
        if not frame.modes:
            self.codes.add(EXIT_REFUSED)

    def _refuse(self, name: str, cause: BadInput) -> None:
        self.codes.add(exit_code_of(cause.reason))
        print(f"{name}  refused  {cause.reason}: {cause}", file=sys.stderr, flush=True)

    def _estimate(self, growing: bool = False) -> Track:
        at_rest = self.args.at_rest
        return self.session.estimate(self._odometry(), at_rest=at_rest, covered_only=growing)

    def _odometry(self) -> Odometry | None:
        return None if self._moves is None else self._moves.read()

    def _write(self, track: Track, pictures: bool = True) -> None:
        from startrack.applications.tracking import draw_track, track_page, write_track
        from startrack.output import png_bytes

        args, odometry, made, moves_m = self.args, None, {}, None
        if args.odometry is not None:
            odometry = {"file": Path(args.odometry).name, "sigma": args.odometry_sigma, "floor_m": args.odometry_floor}
        if pictures and not args.no_plots:
            if odometry is not None and not args.at_rest:
                moves_m = self.session.odometry_positions_m(track, self._odometry())
            picture = png_bytes(draw_track(track, moves_m))
            title = f"Track of {Path(args.frames[0]).resolve().name}"
            page = track_page(track, picture, title=title, odometry_m=moves_m)
            made = {"track.png": picture, "track.html": page.encode()}
        write_track(track, Path(args.dir), odometry=odometry, pictures=made)


def _line(record: dict[str, Any], prefix: str) -> str:
    """One line about a frame."""
    radius = record[f"{prefix}radius95_m"]
    if record[f"{prefix}east_m"] is None or radius is None:
        place = "no position"
    else:
        place = f"E {record[f'{prefix}east_m']:.1f} m  N {record[f'{prefix}north_m']:.1f} m  ±{radius:.1f} m (95 %)"
    status = record["status"].replace("_", " ")
    why = f"  {record['reason']}: {record['message']}" if record["reason"] else ""
    slip = "  after a slip" if record["slipped"] else ""
    return f"{record['image']}  {status}  {place}{slip}{why}"
