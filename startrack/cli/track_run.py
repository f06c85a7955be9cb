"""One run of `startrack track`: locates images, estimates the track, prints and writes it."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.cli.odometry_file import OdometryFile
from startrack.cli.preparation import prepare_reference
from startrack.cli.progress import progress
from startrack.core.errors import EXIT_BAD_INPUT, EXIT_STOPPED, BadInput, exit_code_of

if TYPE_CHECKING:
    from startrack.applications.tracking import ObservedFrame, Odometry, Track, TrackSession
    from startrack.core.types import Exposure

Source = tuple[str, "Callable[[], ObservedFrame]"]  # of one image: its name, and what adds it to the track
QUICK_S = 0.2  # files that take longer are written when no image waits


class TrackRun:
    """One run of the command: what it prints and writes."""

    def __init__(self, args: argparse.Namespace, session: TrackSession) -> None:
        self.args, self.session = args, session
        self.codes: set[int] = {0}
        self._is_old, self._write_s = False, 0.0  # the files; what writing them took
        self._printed = 0  # lines at rest
        self._shown: set[str] = set()  # facts whose gross error an image showed
        self._moves = (
            None if args.odometry is None else OdometryFile(args.odometry, args.odometry_topic, bool(args.follow))
        )  # fmt: skip

    def take_all(self) -> None:
        """Locate all images, then estimate and write the track."""
        paths = self._paths()
        with progress("track", len(paths or ()), shown=paths is not None and not self.args.quiet) as bar:
            for name, add in self._exposures_of_bag() if paths is None else self._images(paths):
                try:
                    self._note(add())
                except BadInput as cause:
                    self._refuse(name, cause)
                bar.advance()
        track = self._whole_track()
        if track is not None:
            self._write(track)
            self._note_unused(track)
            self._print_frames(track)
            self._print_summary(track)

    def follow(self) -> None:
        """Take images as they come; Ctrl-C and SIGTERM end it, before the first image with the code of a stop."""
        import signal

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
            ):  # fmt: skip
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
        track = self._whole_track(growing=True)
        if track is not None:
            self._write(track)
            self._note_unused(track)
            self._print_summary(track)

    def _note_unused(self, track: Track) -> None:
        if any(frame.status != "used" for frame in track.frames):
            self.codes.add(3)

    def _update(self, has_come: bool) -> None:
        """A line about each image that the odometry reaches; the files, unless the next image would wait for them."""
        if not (has_come or self._is_old or self._waits()):
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

    def _waits(self) -> bool:
        """Whether images wait for the odometry, whose file has changed."""
        return self._moves is not None and self.session.waits and self._moves.has_changed

    def _print_newest(self) -> bool:
        """Print a line about each image that has none yet; whether there was one."""
        from startrack.applications.tracking import frame_records

        args, session = self.args, self.session
        before = self._printed
        if args.at_rest:
            self._printed = len(session.frames)
            records = frame_records(self._estimate())[before:]
        else:
            records = []
            for track in session.newest(
                self._odometry(), odometry_sigma=args.odometry_sigma, odometry_floor_m=args.odometry_floor
            ):
                records += frame_records(track)
        for record in records:
            if args.json:
                print(json.dumps(record), flush=True)
            elif not args.quiet:
                print(_line(record, "filtered_"), flush=True)
        return bool(records)

    def _paths(self) -> list[str] | None:
        """The image files; None for a bag."""
        from startrack.applications.batch import images_under
        from startrack.exposure import is_bag

        first = Path(self.args.frames[0])
        if len(self.args.frames) == 1 and is_bag(first):
            return None
        paths = [one.path for one in images_under(first, self.args.dir)] if first.is_dir() else self.args.frames
        if not paths:
            raise BadInput("bad_image", f"{first}: no images in this folder")
        return list(paths)

    def _images(self, paths: list[str]) -> Iterator[Source]:
        yield from ((Path(path).name, partial(self._add, path)) for path in paths)

    def _exposures_of_bag(self) -> Iterator[Source]:
        from startrack.applications.tracking import read_bag_exposures

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
                print(
                    f"{frame.name}  the image shows {one.text}, which no file states: the track estimates it",
                    file=sys.stderr, flush=True,
                )  # fmt: skip
        if not frame.modes:
            self.codes.add(3)

    def _refuse(self, name: str, cause: BadInput) -> None:
        self.codes.add(exit_code_of(cause.reason))
        print(f"{name}  refused  {cause.reason}: {cause}", file=sys.stderr, flush=True)

    def _whole_track(self, growing: bool = False) -> Track | None:
        """The track of all images; None, with the reasons on stderr, where none has a position."""
        try:
            return self._estimate(growing)
        except BadInput as cause:
            if exit_code_of(cause.reason) == EXIT_BAD_INPUT:
                raise
            for frame in self.session.frames:
                if not frame.reason:
                    continue
                print(f"{frame.name}  refused  {frame.reason}: {frame.message}", file=sys.stderr, flush=True)
            print(f"startrack: {cause.reason}: {cause}", file=sys.stderr, flush=True)
            self.codes.add(exit_code_of(cause.reason))
            return None

    def _estimate(self, growing: bool = False) -> Track:
        args = self.args
        return self.session.estimate(
            self._odometry(), odometry_sigma=args.odometry_sigma, odometry_floor_m=args.odometry_floor,
            at_rest=args.at_rest, covered_only=growing,
        )  # fmt: skip

    def _odometry(self) -> Odometry | None:
        return None if self._moves is None else self._moves.read()

    def _write(self, track: Track, pictures: bool = True) -> None:
        from startrack.applications.tracking import write_track

        args, odometry = self.args, None
        if args.odometry is not None:
            odometry = {"file": Path(args.odometry).name, "sigma": args.odometry_sigma, "floor_m": args.odometry_floor}
        made = self._pictures(track) if pictures and not args.no_plots else {}
        write_track(track, Path(args.dir), odometry=odometry, pictures=made)

    def _pictures(self, track: Track) -> dict[str, bytes]:
        from startrack.applications.tracking import draw_track, track_page
        from startrack.output.write import png_bytes

        args, moves_m = self.args, None
        if args.odometry is not None and not args.at_rest:
            moves_m = self.session.odometry_positions_m(
                track, self._odometry(), odometry_sigma=args.odometry_sigma, odometry_floor_m=args.odometry_floor
            )
        picture = png_bytes(draw_track(track, moves_m))
        title = f"Track of {Path(args.frames[0]).resolve().name}"
        page = track_page(track, picture, title=title, odometry_m=moves_m)
        return {"track.png": picture, "track.html": page.encode()}

    def _print_frames(self, track: Track) -> None:
        from startrack.applications.tracking import frame_records

        for record in frame_records(track):
            if self.args.json:
                print(json.dumps(record))
            elif not self.args.quiet:
                print(_line(record, ""))

    def _print_summary(self, track: Track) -> None:
        from startrack.applications.tracking import track_record

        if self.args.quiet or self.args.json:
            return
        counts = track_record(track)["counts"]
        print(
            f"{counts['frames']} frames: {counts['used']} used, {counts['left_out']} left out, {counts['refused']} "
            f"refused; {counts['slips']} slips of the odometry; files in {self.args.dir}/track.*"
        )


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
