"""A video as a source: its sharpest frames, as photographs."""

from pathlib import Path

from mgs.data.tracks import Spacing
from mgs.errors import InputError
from mgs.files import read_json, write_json
from mgs.images import write_png
from mgs.progress import report

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
JUDGED = 640  # longer side, pixels, to which frames are reduced to compare how sharp they are


def sharpest_frames(video: Path, folder: Path, spacing: Spacing) -> list[Path]:
    """Write the sharpest frame of each time of `spacing` into a folder, and return their files. The
    sharpest has the largest variance of the Laplacian. A video that ends in the middle gives the
    frames before. A folder that already holds them is taken as it is. Raises InputError for a
    spacing in metres, and if the video cannot be read."""
    import cv2

    if spacing.metres:
        raise InputError(f"{video}: a video has no distances; give keyframes in seconds, as 0.5s")
    about = [str(video.resolve()), video.stat().st_mtime_ns, spacing.least]
    record = folder / "video.json"
    if record.is_file() and read_json(record) == about:
        return sorted(folder.glob("*.png"))
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.png"):
        old.unlink()
    capture = cv2.VideoCapture(str(video))
    rate, total = capture.get(cv2.CAP_PROP_FPS), int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    window, number = max(1, round(rate * spacing.least)), 0
    best, sharpest = None, -1.0
    while True:
        there, frame = capture.read()
        if best is not None and (not there or number % window == 0):
            write_png(folder / f"{number:06d}.png", cv2.cvtColor(best, cv2.COLOR_BGR2RGB))
            best, sharpest = None, -1.0
        if not there:
            break
        if number % window == 0:
            report("frames of the video", number, max(total, number))
        scale = min(1.0, JUDGED / max(frame.shape))
        small = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        grey = cv2.cvtColor(small, cv2.COLOR_BGR2GRAY)
        if (sharpness := float(cv2.Laplacian(grey, cv2.CV_64F).var())) > sharpest:
            best, sharpest = frame, sharpness
        number += 1
    capture.release()
    if number == 0:
        raise InputError(f"{video}: not a readable video, or cut off; convert it to MP4 (H.264)")
    write_json(record, about)
    return sorted(folder.glob("*.png"))
