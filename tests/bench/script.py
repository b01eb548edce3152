"""What people write instead of motionstereo: a plain loop around cv2's matchers.

``python script.py LEFT RIGHT OUT FOCAL_PX BASELINE_M [--sgbm] [--videos]`` writes
OUT/depth/000000.png, uint16 in mm, and OUT/steering.csv; and, with ``--videos``, the right view and
the depth in colour as H.264. It stands alone, to be read and run by anyone who doubts the figures.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

STRIPS = 16
BM_BLOCK_PX = 21
SGBM_BLOCK_PX = 11


def main() -> None:
    """Read both videos, match frame by frame, write."""
    parser = argparse.ArgumentParser()
    parser.add_argument("left")
    parser.add_argument("right")
    parser.add_argument("out", type=Path)
    parser.add_argument("focal_px", type=float)
    parser.add_argument("baseline_m", type=float)
    parser.add_argument("--sgbm", action="store_true", help="StereoSGBM instead of StereoBM")
    parser.add_argument("--videos", action="store_true", help="two videos besides")
    parser.add_argument("--disparities", type=int, default=64)
    given = parser.parse_args()

    matcher: cv2.StereoMatcher
    if given.sgbm:
        matcher = cv2.StereoSGBM.create(
            numDisparities=given.disparities,
            blockSize=SGBM_BLOCK_PX,
            P1=8 * SGBM_BLOCK_PX**2,
            P2=32 * SGBM_BLOCK_PX**2,
            uniquenessRatio=10,
        )
    else:
        matcher = cv2.StereoBM.create(given.disparities, BM_BLOCK_PX)
    depth_times_px = given.focal_px * given.baseline_m
    (given.out / "depth").mkdir(parents=True, exist_ok=True)
    videos = [Video(given.out / f"{name}.mp4") for name in ("view", "depth")] * given.videos
    left, right = cv2.VideoCapture(given.left), cv2.VideoCapture(given.right)
    with (given.out / "steering.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["frame", "steer", "nearest_m"])
        frame = 0
        while True:
            (left_ok, left_image), (right_ok, right_image) = left.read(), right.read()
            if not (left_ok and right_ok):
                break
            greys = (cv2.cvtColor(i, cv2.COLOR_BGR2GRAY) for i in (left_image, right_image))
            disparity_px = matcher.compute(*greys).astype(np.float32) / 16

            known = disparity_px > 0
            depth_m = np.zeros_like(disparity_px)
            depth_m[known] = depth_times_px / disparity_px[known]
            depth_mm = np.clip(depth_m * 1000, 0, 65535).astype(np.uint16)
            path = str(given.out / "depth" / f"{frame:06d}.png")
            if not cv2.imwrite(path, depth_mm):
                raise OSError(f"cannot write {path}")

            if videos:
                videos[0].write(right_image)
                level = np.clip(disparity_px * (255 / given.disparities), 0, 255)
                videos[1].write(cv2.applyColorMap(level.astype(np.uint8), cv2.COLORMAP_TURBO))

            # Steer for the strip that is farthest in the mean.
            sums = [float(s.sum()) for s in np.array_split(depth_m, STRIPS, axis=1)]
            counts = [int(np.count_nonzero(s)) for s in np.array_split(known, STRIPS, axis=1)]
            means = [total / max(count, 1) for total, count in zip(sums, counts, strict=True)]
            steer = 1 - 2 * (means.index(max(means)) + 0.5) / STRIPS
            nearest_m = float(depth_m[known].min()) if known.any() else ""
            table.writerow([frame, steer, nearest_m])
            frame += 1
    for video in videos:
        video.close()


class Video:
    """An H.264 video of BGR images."""

    def __init__(self, path: Path) -> None:
        self._container = av.open(str(path), "w")
        self._stream: Any = self._container.add_stream("libx264", rate=30)
        self._stream.options = {"preset": "ultrafast", "qp": "22"}
        self._stream.pix_fmt = "yuv420p"

    def write(self, image: np.ndarray[Any, Any]) -> None:
        """Add an image."""
        if not self._stream.codec_context.is_open:
            self._stream.height, self._stream.width = image.shape[:2]
        self._container.mux(self._stream.encode(av.VideoFrame.from_ndarray(image, "bgr24")))

    def close(self) -> None:
        """Complete the file."""
        self._container.mux(self._stream.encode())
        self._container.close()


if __name__ == "__main__":
    main()
