"""Picture of the page Studio: the page in headless Chromium. Needs `pip install playwright` and Chromium.

python docs/images/studio.py [--chromium /usr/bin/chromium] [--width 1280] [--dark] [--arm] [--photo] [--out PICTURE]
"""

import argparse
from pathlib import Path

from playwright.sync_api import sync_playwright

from foretrace.studio.choices import Choices
from foretrace.studio.server import StudioServer

FIRST = "along:0.79,friction:unknown,tool_friction:unknown"
SOFTWARE = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
"""Draws in three dimensions without a graphics card."""
EYE = (0.24, -0.22, 0.17)
"""Where the camera is, in the object's frame [m]."""
EYE_OF_ARM = (0.62, 0.3, 0.26)
"""Where it is to show the whole arm."""
SECONDS = 2.0
"""The moment that is shown [s]."""


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--chromium", default=None)
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--height", type=int, default=760)
    parser.add_argument("--dark", action="store_true")
    parser.add_argument("--arm", action="store_true", help="with the arm")
    parser.add_argument("--photo", action="store_true", help="the object of the example photograph")
    parser.add_argument("--at", default=FIRST)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".png"))
    options = parser.parse_args()
    server = StudioServer(port=0, choices=Choices.from_text(options.at), dark=options.dark)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=options.chromium, args=list(SOFTWARE))
        page = browser.new_page(viewport={"width": options.width, "height": options.height})
        page.goto(f"http://{server.address}")
        page.get_by_text("levered", exact=True).first.wait_for(timeout=120_000)
        visitor = next(iter(server.pages.values()))
        visitor.controls.play.value = False
        if options.photo:
            visitor.act(visitor._take_example_photo)
        visitor.controls.arm.value = options.arm
        visitor.act(lambda: None)
        visitor.show_from(EYE_OF_ARM if options.arm else EYE)
        visitor.controls.time.value = SECONDS
        visitor.stage.show_time(SECONDS)
        page.locator(".mantine-Notification-closeButton").first.click(timeout=120_000)
        page.wait_for_timeout(15_000)
        if options.photo:
            page.get_by_role("tab", name="Object").click()
            page.get_by_text("Photograph", exact=True).click(timeout=120_000)
            page.get_by_text("find the object").wait_for(timeout=120_000)
            page.wait_for_timeout(5_000)
        page.screenshot(path=options.out, timeout=120_000)
        browser.close()
    server.stop()
    print(options.out)


if __name__ == "__main__":
    main()
