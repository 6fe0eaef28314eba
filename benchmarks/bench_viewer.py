"""How fast the viewer decodes and plays a sequence in headless Chromium, which draws in software.

    python benchmarks/bench_viewer.py SCENE [--splats 50000] [--frames 60]

A still scene is made into moving keyframes and written as one .sog4d. Printed: keyframes decoded a second when nothing is
drawn, and keyframes decoded and pictures drawn a second while it plays at 30 keyframes a second.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from machine import describe_machine
from playwright.sync_api import sync_playwright

sys.path.insert(0, str(Path(__file__).parents[1]))

from gsplat_tools import load
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.formats import save
from gsplat_tools.ops.sampling import crop
from gsplat_tools.sequence import GaussianSequence
from tests.browser import chromium
from tests.viewer.conftest import serving

PLAYED_SECONDS = 2.0  # one time through the frames: after that they are kept and nothing is decoded


@contextmanager
def moving_bundle(path: Path, splats: int, frames: int):
    """A scene whose splats move along a wave, as a bundle of keyframes."""
    cloud = load(path)
    assert isinstance(cloud, GaussianCloud)
    cloud = crop(cloud, splats)
    extent = float(np.ptp(cloud.means, axis=0).mean())

    def frame(k: int) -> GaussianCloud:
        wave = np.sin(2 * np.pi * (k / frames + cloud.means / extent)) * 0.02 * extent
        return cloud.replace(means=cloud.means + wave.astype(np.float32))

    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "moving.sog4d"
        scene = GaussianSequence(frame, num_splats=len(cloud), sh_degree=cloud.sh_degree, num_frames=frames)
        report = save(scene, target)
        print(f"{report.splats:,} splats, SH degree {report.sh_degree}, {frames} keyframes, {report.bytes:,} bytes")
        yield target


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("scene", type=Path)
    parser.add_argument("--splats", type=int, default=50_000)
    parser.add_argument("--frames", type=int, default=60)
    arguments = parser.parse_args()
    print(describe_machine())
    flags = [flag for flag in chromium.FLAGS if flag != "--headless"]
    with (
        moving_bundle(arguments.scene, arguments.splats, arguments.frames) as bundle,
        serving(bundle) as server,
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=chromium.executable(), args=flags)
        page = browser.new_page(viewport={"width": 480, "height": 270})
        page.goto(server.address)
        while not page.evaluate("window.viewer && window.viewer.ready"):
            time.sleep(0.1)
        page.evaluate("viewer.paused = true")
        race = "async (frames) => (await viewer.state.sources[0].player.call({ type: 'race', frames })).seconds"
        page.evaluate(race, arguments.frames)
        seconds = min(page.evaluate(race, arguments.frames) for _ in range(3))
        print(f"decoding alone: {arguments.frames / seconds:.1f} keyframes a second")
        for drawn in (False, True):
            page.evaluate(race, 1)  # empties what is kept
            page.evaluate(f"viewer.paused = {'false' if drawn else 'true'}")
            before = page.evaluate("[viewer.state.sources[0].player.decoded, viewer.stage.renderer.info.render.frame]")
            page.keyboard.press(" ")
            time.sleep(PLAYED_SECONDS)
            page.keyboard.press(" ")
            after = page.evaluate("[viewer.state.sources[0].player.decoded, viewer.stage.renderer.info.render.frame]")
            keyframes, pictures = ((b - a) / PLAYED_SECONDS for a, b in zip(before, after, strict=True))
            how = "drawn in software" if drawn else "not drawn"
            print(f"playing, {how}: {keyframes:.1f} keyframes, {pictures:.1f} pictures a second")
        browser.close()


if __name__ == "__main__":
    main()
