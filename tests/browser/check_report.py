"""Opens report.html of result folders in headless Chromium, from disk, and checks what a person would.

check_report.py [--screenshots DIR] RESULT...

No console error; no request; every chart drawn; the 3D view drawn and different after each switch and key; everything reached by
keyboard; no serious finding of axe-core in light and dark; no sideways scrolling at 390 px; a PDF of all sections.
"""

import argparse
import os
import pathlib
import sys
import time

import axe_playwright_python
from playwright.sync_api import sync_playwright

SIZE_LIMIT_MB = 15.0
AXE = (pathlib.Path(axe_playwright_python.__file__).parent / "axe.min.js").read_text(encoding="utf-8")
# A software renderer, so that a machine without graphics draws WebGL too.
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]


class Failed(Exception):
    """What a person would complain of."""


def expect(condition, complaint):
    if not condition:
        raise Failed(complaint)


def differing(one, other):
    """Whether two images (PNG bytes) differ; compared by the browser-independent bytes."""
    return one != other


def scene_pixels(page):
    """Number of colours of the 3D canvas, sampled."""
    return page.evaluate(
        """async () => {
          const place = document.getElementById('view3d');
          const url = await Plotly.toImage(place, {format: 'png', width: 480, height: 320});
          const image = new Image(); image.src = url; await image.decode();
          const canvas = document.createElement('canvas'); canvas.width = 480; canvas.height = 320;
          const drawing = canvas.getContext('2d'); drawing.drawImage(image, 0, 0);
          const bytes = drawing.getImageData(0, 0, 480, 320).data;
          const colours = new Set();
          for (let k = 0; k < bytes.length; k += 4) colours.add(bytes[k] << 24 | bytes[k+1] << 16 | bytes[k+2] << 8 | bytes[k+3]);
          return colours.size;
        }"""
    )


def settled(page):
    """Waits until the charts are there and the 3D view has stopped drawing."""
    page.wait_for_function("document.querySelectorAll('.plot .main-svg').length >= document.querySelectorAll('.plot').length")
    page.wait_for_timeout(600)


def audit(page, name):
    page.evaluate(AXE)
    found = page.evaluate("async () => (await axe.run(document)).violations")
    serious = [rule for rule in found if rule["impact"] in ("serious", "critical")]
    for rule in found:
        places = [node["target"] for node in rule["nodes"][:3]]
        print(f"    axe, {name}: {rule['impact']}: {rule['id']}: {rule['help']} at {places}")
    expect(not serious, f"axe-core has {len(serious)} serious findings ({name})")


def open_page(browser, path, problems, **options):
    context = browser.new_context(**options)
    # A busy machine without graphics is slow, and slow is no fault of the page.
    context.set_default_timeout(240_000)
    page = context.new_page()
    # Warnings are Chromium's hints to plotly.js about speed.
    page.on("console", lambda message: problems.append(f"console: {message.text}") if message.type == "error" else None)
    page.on("pageerror", lambda error: problems.append(f"script: {error}"))

    def no_network(route):
        url = route.request.url
        if url.startswith(("file:", "data:", "blob:")):
            route.continue_()
        else:
            problems.append(f"request: {url}")
            route.abort()

    context.route("**/*", no_network)
    page.goto(path.resolve().as_uri())
    settled(page)
    return page


def check_switches(page):
    scene = page.locator("#view3d")
    scene.scroll_into_view_if_needed()
    page.wait_for_timeout(400)
    colours = scene_pixels(page)
    expect(colours > 30, f"the 3D view is uniform: {colours} colours")
    images = [scene.screenshot()]
    # By keyboard alone: from the checked button of the group to its neighbour.
    page.locator('input[name="poses"]:checked').focus()
    page.keyboard.press("ArrowLeft")
    expect(page.locator('input[name="poses"]:checked').input_value() == "nominal", "the arrow key does not switch to the nominal poses")
    page.wait_for_timeout(900)
    images.append(scene.screenshot())
    if page.locator('input[name="color"]').count():
        for value in ("image", "distance"):
            page.locator('input[name="color"]:checked').focus()
            page.keyboard.press("ArrowRight")
            expect(page.locator('input[name="color"]:checked').input_value() == value, f"the arrow key does not switch to {value}")
            page.wait_for_timeout(900)
            images.append(scene.screenshot())
    scene.focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowUp")
    page.keyboard.press("+")
    page.wait_for_timeout(900)
    images.append(scene.screenshot())
    for at in range(1, len(images)):
        expect(differing(images[at - 1], images[at]), f"the 3D view did not change at step {at}")
    said = page.locator("#scene-said").inner_text()
    expect("nominal" in said, f"the state is not shown: {said!r}")
    page.keyboard.press("0")
    return colours, len(images)


def check_keyboard(page):
    """Tab from the top reaches the skip link first, then contents, switches, 3D view and tables, and gets out of each."""
    page.evaluate("() => { document.activeElement?.blur(); window.scrollTo(0, 0); }")
    reached = []
    for _ in range(80):
        page.keyboard.press("Tab")
        reached.append(
            page.evaluate("() => { const e = document.activeElement; return e.id || e.className || e.name || e.tagName; }")
        )
    expect(reached[0] == "skip", f"the first stop is {reached[0]!r} and not the skip link")
    expect("view3d" in reached, "Tab does not reach the 3D view")
    after = reached[reached.index("view3d") + 1 :]
    expect(any(stop == "scroll" for stop in after), "Tab does not leave the 3D view for the tables")


def check_width(page):
    width, inner = page.evaluate("() => [document.documentElement.scrollWidth, window.innerWidth]")
    expect(width <= inner, f"the page is {width} px wide on a screen of {inner} px")


def check(browser, result, screenshots):
    path = result / "report.html"
    size = path.stat().st_size / 1e6
    expect(size <= SIZE_LIMIT_MB, f"{size:.1f} MB, above {SIZE_LIMIT_MB} MB")
    problems = []

    def screenshot(page, name):
        if screenshots:
            page.evaluate("window.scrollTo(0, 0)")
            page.wait_for_timeout(300)
            page.screenshot(path=screenshots / f"{result.name}-{name}.jpg", type="jpeg", quality=78)
            page.screenshot(path=screenshots / f"{result.name}-{name}-full.png", full_page=True)

    begin = time.monotonic()
    page = open_page(browser, path, problems, viewport={"width": 1440, "height": 900}, color_scheme="light")
    opened = time.monotonic() - begin
    plots, drawn = page.evaluate(
        "() => { const all = [...document.querySelectorAll('.plot')]; return [all.length, all.filter((p) => p._fullLayout).length]; }"
    )
    expect(plots == drawn and plots > 0, f"{drawn} of {plots} charts are drawn")
    check_width(page)
    screenshot(page, "1440-light")
    check_keyboard(page)
    colours, steps = check_switches(page)
    audit(page, "light")
    page.wait_for_selector(".paper", state="attached")
    pdf = page.pdf(format="A4", print_background=True)
    if screenshots:
        (screenshots / f"{result.name}.pdf").write_bytes(pdf)
    pages = pdf.count(b"/Type /Page\n") + pdf.count(b"/Type /Page ") + pdf.count(b"/Type /Page/")
    page.context.close()

    for width, scheme in ((1440, "dark"), (390, "light"), (390, "dark")):
        height = 900 if width > 400 else 844
        page = open_page(browser, path, problems, viewport={"width": width, "height": height}, color_scheme=scheme)
        check_width(page)
        audit(page, f"{width} px, {scheme}")
        screenshot(page, f"{width}-{scheme}")
        page.context.close()
    expect(not problems, "; ".join(problems[:5]))
    print(
        f"  {result.name}: {size:.1f} MB, opened and drawn in {opened:.1f} s, {plots} charts, 3D view of {colours} colours, "
        f"{steps} images of it all different, PDF of {len(pdf) / 1e6:.1f} MB, {pages} pages"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("results", nargs="+", type=pathlib.Path)
    parser.add_argument("--screenshots", type=pathlib.Path, help="keep images and the PDF in this folder")
    arguments = parser.parse_args()
    if arguments.screenshots:
        arguments.screenshots.mkdir(parents=True, exist_ok=True)
    failed = 0
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=os.environ.get("CHROMIUM") or None, args=FLAGS)
        print(f"Chromium {browser.version}")
        for result in arguments.results:
            try:
                check(browser, result, arguments.screenshots)
            except Failed as complaint:
                print(f"  {result.name}: FAILED: {complaint}")
                failed += 1
        browser.close()
    if failed:
        sys.exit(f"{failed} of {len(arguments.results)} reports failed")
    print("The reports open offline, draw, switch, and can be used by keyboard.")


if __name__ == "__main__":
    main()
