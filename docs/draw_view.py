"""Draws pictures/view.png: the page of `stmpl view --tool A`, a letter pressed into the forearm, as Chromium shows it.

.venv/bin/python docs/draw_view.py     # Chromium on the path, or its file in CHROMIUM; extras view and dev
"""

import os
import shutil
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
from playwright.sync_api import sync_playwright  # noqa: E402

from stmpl_core.methods import MomentNet  # noqa: E402
from stmpl_ros.making import layer_of  # noqa: E402
from stmpl_ros.parameters import NodeConfig  # noqa: E402
from stmpl_ros.view.hands_on import HandsOn  # noqa: E402
from stmpl_ros.view.page import Page  # noqa: E402

SIZE = {"width": 1280, "height": 760}  # of the window [px]
PUSHES = [1e-3] * 9 + [-1e-3] * 3 + [1e-3] * 5  # of the tool into the skin [m]
PATIENCE = 300.0  # for an answer, the first of which compiles [s]
PAUSE, PATIENCE_TO_DRAW = 0.2, 15.0  # between pushes, and for a processor that draws the skin [s]
FLAGS = ["--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def main() -> None:
    """Presses, opens the page and takes its picture."""
    chromium = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        sys.exit("no Chromium is installed; on Debian and Ubuntu: apt-get install chromium")
    config = NodeConfig()
    page = Page("127.0.0.1", 8080, f"{config.limb.replace('_', ' ')}, {config.method}")
    hand = HandsOn(page, layer_of(config), MomentNet(), "A")
    assert hand.wait(PATIENCE), f"no answer within {PATIENCE} s"
    for distance in PUSHES:
        hand.push(distance)
        assert hand.wait(PATIENCE)
        time.sleep(PAUSE)
    with sync_playwright() as playwright:
        tab = playwright.chromium.launch(executable_path=chromium, args=FLAGS).new_page(viewport=SIZE)
        tab.set_default_timeout(1e3 * PATIENCE)
        tab.goto(page.url)
        tab.get_by_text("reaction force").wait_for()
        tab.locator(".mantine-Notification-closeButton").first.click()  # a note on drawing without a GPU
        tab.wait_for_timeout(1e3 * PATIENCE_TO_DRAW)
        tab.screenshot(path=HERE / "pictures" / "view.png")
    hand.close()
    page.close()


if __name__ == "__main__":
    main()
