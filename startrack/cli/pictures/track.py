"""`startrack track`: the images of a drive, or of a rover at rest, to a trajectory."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from startrack.applications import tracking
from startrack.applications.batch import image_tree, images_under
from startrack.applications.tracking import FrameStore, ObservedFrame, Odometry, OdometryFile, Track, TrackSession
from startrack.catalog import load_catalog
from startrack.chain import Settings
from startrack.cli.console import print_refusal, progress, worst_code
from startrack.cli.images import (
    flag_facts,
    maps_left_out,
    near_attitude_of,
    odometry_errors,
    prepare_reference,
)
from startrack.core.errors import EXIT_BAD_INPUT, EXIT_REFUSED, EXIT_STOPPED, BadInput, BadOutput, exit_code_of
from startrack.core.files import make_folder, printable
from startrack.core.types import Exposure
from startrack.exposure import is_bag, read_exposure
from startrack.output import png_bytes

STORE = ".frames"  # in OUT
QUICK_S = 0.2  # files that take longer are written when no image waits


def run(args: argparse.Namespace) -> int:
    """Estimate and write the track; the exit code of its worst image."""
    _check_flags(args)
    out = make_folder(args.dir)
    if not args.overwrite and (out / "track.json").exists() and not (out / STORE).is_dir():
        raise BadOutput(
            "bad_image", f"{out} holds a track that this command did not write: choose another -D, or give -O"
        )
    session = TrackSession(
        store=FrameStore(out / STORE), facts=flag_facts(args), odometry_errors=odometry_errors(args),
        settings=Settings(evidence_sources=args.evidence, near_attitude=near_attitude_of(args)),
    )  # fmt: skip
    track = TrackRun(args, session)
    try:
        (track.follow if args.follow else track.take_all)()
    finally:
        if (out / "track.json").exists() and not track.has_written:
            print(f"startrack: the files {printable(out)}/track.* are of an earlier run", file=sys.stderr, flush=True)
    return worst_code(track.all_codes)


def _check_flags(args: argparse.Namespace) -> None:
    """A usage error for flags that do not go together. Raises BadInput (bad_image) where no path of FRAMES exists."""
    if args.odometry is not None and args.at_rest:
        args.usage_error("--odometry is for a rover that moves, --at-rest for one that does not: give one of them")
    if args.time is not None:
        args.usage_error("--time is that of one image: the images of a track have their times in sidecars or headers")
    if args.follow and (len(args.frames) != 1 or not Path(args.frames[0]).is_dir()):
        args.usage_error(f"--follow takes one folder, into which images are written: {args.frames[0]} is no folder")
    if args.until_idle is not None and not args.follow:
        args.usage_error("--until-idle is for --follow")
    if not any(os.path.exists(path) for path in args.frames):  # one missing image of several is refused later
        first = printable(args.frames[0])
        raise BadInput(
            "bad_image", f"{first}: no such file or folder: give images, one folder of images, or one ROS bag"
        )


class TrackRun:
    """One run of the command: what it prints and writes."""

    def __init__(self, args: argparse.Namespace, session: TrackSession) -> None:
        self.args, self.session = args, session
        self.codes: set[int] = set()
        self._unread: list[tuple[str, int]] = []  # images that could not be read, and the exit code of each
        self._is_old, self._write_s = False, 0.0  # the files; what writing them took
        self._printed = 0  # lines at rest
        self._warned: set[str] = set()  # what was said of the odometry
        self._has_ended = False  # no more images come, and no odometry
        self._shown: set[str] = set()  # facts whose gross error an image showed
        self.has_written = False
        self._moves: OdometryFile | None = None
        if args.odometry is not None:
            self._moves = OdometryFile(args.odometry, args.odometry_topic, bool(args.follow), args.odometry_floor)

    @property
    def all_codes(self) -> set[int]:
        """Exit codes of what happened, with those of images that could not be read."""
        return {*self.codes, *(code for _, code in self._unread)}

    def take_all(self) -> None:
        """Locate all images, then estimate and write the track."""
        self._odometry()  # a file that cannot be read is refused before any image is located
        first = Path(self.args.frames[0])
        paths: list[str] | None = list(self.args.frames)
        if len(self.args.frames) == 1 and is_bag(first):
            paths = None
        elif first.is_dir():
            images = images_under(first, self.args.dir)
            maps = maps_left_out(images)
            paths = [one.path for one in images if one not in maps]
            if not paths:
                raise BadInput("bad_image", f"{first}: no images in this folder")
        with progress(
            f"track {len(paths or ())} images", len(paths or ()), shown=paths is not None and not self.args.quiet
        ) as bar:
            if paths is None:
                bag = tracking.read_bag_exposures(first, self.args.image_topic, **self.session.facts)
                sources = ((exposure.name, partial(self._add_exposure, exposure)) for exposure in bag)
            else:
                base = first if first.is_dir() else None
                names = [Path(path).name if base is None else os.path.relpath(path, base) for path in paths]
                sources = ((printable(name), partial(self._add, path)) for name, path in zip(names, paths, strict=True))
            for name, add in sources:
                try:
                    add()
                except BadInput as cause:
                    self._refuse(name, cause)
                bar.advance()
        self._finish()

    def follow(self) -> None:
        """Take images as they come; Ctrl-C and SIGTERM end it, before the first image with the code of a stop."""
        folder = self.args.frames[0]
        tree = image_tree(folder, self.args.dir)
        load_catalog()  # before the first image comes
        prepare_reference(self.args.terrain, self.args)
        former = signal.signal(signal.SIGTERM, signal.default_int_handler)

        def forget(path: str) -> str:
            """Name of an image; that it could not be read before counts no more."""
            name = printable(os.path.relpath(path, folder))
            self._unread = [one for one in self._unread if one[0] != name]
            return name

        def take(path: str) -> None:
            self._add(path)
            forget(path)

        try:
            for path in tracking.follow_images(
                lambda: [os.path.join(folder, name) for name in tree.changes()],
                take,
                lambda path, cause: self._refuse(forget(path), cause),
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
            self._has_ended = True
            self._update(has_come=False)  # images after the last pose wait no longer
        self._finish(was_live=True)

    def _finish(self, was_live: bool = False) -> None:
        """Write and print the track of all images, with `was_live` without their lines; the reasons where none is."""
        try:
            track = self._estimate()
        except BadInput as cause:
            if exit_code_of(cause.reason) == EXIT_BAD_INPUT:
                raise
            for frame in self.session.frames:
                if frame.reason:
                    self._print_refusal(frame.name, frame.reason, frame.message)
            self._print_refusal("startrack track", cause.reason, str(cause))
            self.codes.add(exit_code_of(cause.reason))
            return
        self._write(track)
        if track.odometry_fault:
            why = "it contradicts the images and is left out"
            print(f"the odometry has {track.odometry_fault}: {why}", file=sys.stderr)
        if track.odometry_fault or any(frame.status != "used" for frame in track.frames):
            self.codes.add(EXIT_REFUSED)
        if not was_live:
            self._print(tracking.frame_records(track), "")
        if not (self.args.quiet or self.args.json):
            for text in track.leg_texts:
                print(printable(text))
            page = "" if self.args.no_plots else f"; page {printable(self.args.dir)}/track.html"
            print(f"{self._summary(track)}; files in {printable(self.args.dir)}/track.*{page}")

    def _summary(self, track: Track) -> str:
        """What became of all images, also of those that could not be read, and of the odometry."""
        counts, unread = tracking.track_record(track)["counts"], len(self._unread)
        of_images = f"{counts['used']} used, {counts['left_out']} left out, {counts['refused'] + unread} refused"
        parts = [f"{counts['frames'] + unread} images: {of_images}"]
        if unread:
            parts[0] += f" ({unread} could not be read)"
        if counts["slips"]:
            parts.append(f"{counts['slips']} moves slipped, in {counts['legs']} legs")
        if counts["outside_odometry"]:
            parts.append(f"{counts['outside_odometry']} outside the odometry")
        return "; ".join(parts)

    def _update(self, has_come: bool) -> None:
        """A line about each image that the odometry reaches; the files, unless the next image would wait for them."""
        waits = self._moves is not None and self.session.waits and self._moves.has_changed
        if not (has_come or self._is_old or waits):
            return
        try:
            records = list(self._newest_records())
            self._print(records, "filtered_")
            self._is_old |= bool(records)
            if self._is_old and (not has_come or self._write_s < QUICK_S):
                start = time.monotonic()
                self._write(self._estimate(), pictures=False)
                self._write_s, self._is_old = time.monotonic() - start, False
        except BadInput as cause:  # no position yet, or no odometry for the first images
            if has_come:
                print(f"waiting: {cause}", file=sys.stderr, flush=True)
            self._is_old = False

    def _newest_records(self) -> Iterator[dict[str, Any]]:
        """The record of each image that was not printed yet."""
        if self.args.at_rest:
            before, self._printed = self._printed, len(self.session.frames)
            yield from tracking.frame_records(self._estimate())[before:]
        else:
            for track in self.session.newest(self._odometry(), has_ended=self._has_ended):
                yield from tracking.frame_records(track)

    def _print(self, records: Sequence[dict[str, Any]], prefix: str) -> None:
        """Print a line, or the JSON object, of each frame; its position is that of the keys with this `prefix`."""
        for record in () if self.args.quiet and not self.args.json else records:
            if self.args.json:
                print(json.dumps(record), flush=True)
                continue
            east_m, north_m, radius_m = (record[f"{prefix}{key}"] for key in ("east_m", "north_m", "radius95_m"))
            is_known = east_m is not None and radius_m is not None
            place = f"E {east_m:.1f} m  N {north_m:.1f} m  ±{radius_m:.1f} m (95 %)" if is_known else "no position"
            notes = ["after a slip"] * record["slipped"] + ["outside the odometry"] * record["outside_odometry"]
            if record["status"] == "refused" and not is_known:
                message = "; ".join([record["message"], *notes])
                self._print_refusal(record["image"], record["reason"], message, to_stdout=True)
                continue
            why = f"  {record['reason']}: {record['message']}" if record["reason"] else ""
            slip = "".join(f"  {note}" for note in notes)
            search = "  search: beam" if record["search"] == "beam" else ""
            status = record["status"].replace("_", " ")
            print(f"{printable(record['image'])}  {status}  {place}{search}{slip}{why}", flush=True)

    def _add(self, path: str) -> None:
        self._add_exposure(read_exposure(path, **self.session.facts), path)

    def _add_exposure(self, exposure: Exposure, path: str | None = None) -> None:
        """Locate the image; print the facts that it shows to be grossly wrong, once each."""
        if self.session.terrain is None:
            prepare_reference(exposure.terrain, self.args)
        frame: ObservedFrame = self.session.add_exposure(exposure, path)
        for one in frame.shown:
            if one.fact not in self._shown:
                self._shown.add(one.fact)
                what = f"the image shows {one.text}, which no file states: the track estimates it"
                print(f"{printable(frame.name)}  {what}", file=sys.stderr, flush=True)
        if not frame.modes:
            self.codes.add(EXIT_REFUSED)

    def _refuse(self, name: str, cause: BadInput) -> None:
        self._unread.append((name, exit_code_of(cause.reason)))
        self._print_refusal(name, cause.reason, str(cause))

    def _print_refusal(self, name: str, reason: str, message: str, *, to_stdout: bool = False) -> None:
        line = f"{printable(name)}  refused  {reason}: {message}"
        print_refusal(self.args, line, reason, message, to_stdout=to_stdout)

    def _estimate(self) -> Track:
        is_live = bool(self.args.follow) and not self._has_ended
        return self.session.estimate(self._odometry(), at_rest=self.args.at_rest, covered_only=is_live)

    def _odometry(self) -> Odometry | None:
        if self._moves is None:
            return None
        odometry = self._moves.read()
        for text in set(odometry.warnings) - self._warned:
            self._warned.add(text)
            print(text, file=sys.stderr, flush=True)
        return odometry

    def _write(self, track: Track, pictures: bool = True) -> None:
        args, odometry, made = self.args, None, {}
        if args.odometry is not None:
            odometry = {"file": Path(args.odometry).name, "sigma": args.odometry_sigma, "floor_m": args.odometry_floor,
                        "time_sigma_s": args.odometry_time_sigma, "fault": track.odometry_fault or None}  # fmt: skip
        if pictures and not args.no_plots:
            title = f"Track of {Path(args.frames[0]).resolve().name}"
            page = tracking.track_page(track, title)
            made = {"track.png": png_bytes(tracking.draw_track(track)), "track.html": page.encode()}
        tracking.write_track(track, Path(args.dir), odometry=odometry, pictures=made)
        self.has_written = True
