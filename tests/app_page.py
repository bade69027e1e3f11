"""The window in a browser, used as a person uses it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

PATIENCE_S = 120.0
"""How long is waited for what should be seen; a loaded machine is slow."""

EVERYWHERE = """
const everywhere = (root, found = []) => {
  for (const node of root.querySelectorAll("*")) {
    found.push(node);
    if (node.shadowRoot) everywhere(node.shadowRoot, found);
  }
  return found;
};
const shown = (node) => node.getClientRects().length > 0;
const named = (tag, text) => everywhere(document).find(
  (node) => node.matches(tag) && shown(node) && node.textContent.trim() === text);
"""
"""Panel's widgets stand in shadow trees, which selectors do not enter."""


@contextmanager
def serving(folder: Path, port: str, log: Path) -> Iterator[subprocess.Popen[str]]:
    """Run `iscat app`; Ctrl-C ends it, and it says nothing went wrong."""
    code = "import sys, iscat_cli; sys.argv = ['iscat', 'app', *sys.argv[1:]]; "
    code += "sys.exit(iscat_cli.main())"
    with log.open("w") as errors:
        server = subprocess.Popen(
            [sys.executable, "-c", code, str(folder), "--port", port],
            stdout=subprocess.PIPE, stderr=errors, text=True,
            env=os.environ | {"BROWSER": "true"},  # which opens nothing
        )  # fmt: skip
        assert server.stdout is not None
        with server.stdout:
            yield server
            server.send_signal(signal.SIGINT)
            assert server.wait(PATIENCE_S) == 0
    said = log.read_text()
    assert "unexpected" not in said, said
    assert "Traceback" not in said, said


class Page:
    """One tab of the browser, used as a person does."""

    def __init__(self, driver: Any) -> None:
        self.driver = driver

    def script(self, code: str, *given: Any) -> Any:
        return self.driver.execute_script(EVERYWHERE + code, *given)

    def until(self, what: str, check: Callable[[], Any]) -> Any:
        """Wait until something is so."""
        end = time.monotonic() + PATIENCE_S
        while not (found := check()):
            assert time.monotonic() < end, f"{what}; the page says: {self.text()[:2000]}"
            time.sleep(0.1)
        return found

    def text(self) -> str:
        return str(
            self.script(
                "return everywhere(document).filter((n) => shown(n) && !n.matches('style, script'))"
                ".flatMap((n) => [...n.childNodes]).filter((n) => n.nodeType === 3)"
                ".map((n) => n.textContent.trim()).filter(Boolean).join('\\n')"
            )
        )

    def says(self, *words: str) -> None:
        self.until(f"{words} is said", lambda: all(word in self.text() for word in words))

    def click(self, text: str, tag: str = "button") -> None:
        node = self.until(
            f"{text} can be clicked",
            lambda: self.script("return named(arguments[0], arguments[1])", tag, text),
        )
        self.driver.execute_script("arguments[0].click()", node)

    def open(self, title: str) -> None:
        self.click(title, ".bk-tab")

    def choose(self, part: str) -> None:
        """Choose what has a text in it from a list that is shown."""
        self.until(
            f"{part} can be chosen",
            lambda: self.script(
                """
                for (const list of everywhere(document).filter((n) => n.matches("select"))) {
                  const option = [...list.options].find((o) => o.text.includes(arguments[0]));
                  if (!option || !shown(list)) continue;
                  list.value = option.value;
                  list.dispatchEvent(new Event("change", { bubbles: true }));
                  return true;
                }
                return false;
                """,
                part,
            ),
        )

    def tick(self, text: str) -> None:
        """Click the box beside a text."""
        box = self.until(
            f"{text} has a box",
            lambda: self.script(
                "return named('.bk-label', arguments[0])?.getRootNode().querySelector('input')",
                text,
            ),
        )
        self.driver.execute_script("arguments[0].click()", box)

    def type(self, label: str, text: str) -> None:
        """Write into the field below a label, and leave it."""
        field = self.until(
            f"{label} is there",
            lambda: self.script(
                """
                const word = everywhere(document).find(
                  (n) => n.matches("label") && shown(n) && n.textContent.trim() === arguments[0]);
                return word?.getRootNode().querySelector("input");
                """,
                label,
            ),
        )
        from selenium.webdriver.common.keys import Keys

        field.clear()
        field.send_keys(text, Keys.TAB)

    def place_in(self, title: str, across: float, *, in_units: bool = False) -> tuple[float, float]:
        """Find a place in the middle of a figure that has an axis of this title.

        `across` is a share of its width, or a value on that axis.
        """
        found = self.until(
            f"{title} is drawn",
            lambda: self.script(
                """
                for (const svg of everywhere(document).filter((n) => n.matches("svg.marks"))) {
                  const titles = [...svg.querySelectorAll(".role-axis-title text")];
                  const title = titles.find((n) => n.textContent === arguments[0]);
                  if (!title || !shown(svg)) continue;
                  svg.scrollIntoView({ block: "center" });
                  const box = svg.querySelector(".role-frame .background").getBoundingClientRect();
                  const labels = title.closest(".role-axis").querySelectorAll(
                    ".role-axis-label text");
                  const ticks = [...labels].map((n) => {
                    const place = n.getBoundingClientRect();
                    return [parseFloat(n.textContent), place.x + place.width / 2];
                  });
                  return [[box.x, box.y, box.width, box.height], ticks[0], ticks.at(-1)];
                }
                """,
                title,
            ),
        )
        (x, y, width, height), (low, left), (high, right) = found
        share = (across - low) / (high - low) if in_units else across
        at = left + share * (right - left) if in_units else x + share * width
        return at, y + height / 2

    def drag(self, title: str, start: float, stop: float, *, in_units: bool = False) -> None:
        """Drag over a figure from one place to another; to the same it is a click."""
        from selenium.webdriver.common.actions.action_builder import ActionBuilder

        self.place_in(title, start, in_units=in_units)  # where it is scrolled to
        mouse = ActionBuilder(self.driver)
        for number, share in enumerate((0.0, 0.3, 0.7, 1.0)):
            at, down = self.place_in(title, start + share * (stop - start), in_units=in_units)
            mouse.pointer_action.move_to_location(round(at), round(down))
            if number == 0:
                mouse.pointer_action.pointer_down()
        mouse.pointer_action.pointer_up()
        mouse.perform()

    def bokeh(self, code: str, *given: Any) -> Any:
        """Ask the models of the figures."""
        return self.script(
            "const models = [...Bokeh.documents[0]._all_models.values()];" + code, *given
        )

    def drawn(self) -> int:
        """Count the pictures that were drawn of the film."""
        return int(
            self.bokeh("return models.find((m) => m.title === 'pictures drawn')?.value ?? 0")
        )
