"""The window in a browser, used as a person uses it."""

from __future__ import annotations

import time
from collections.abc import Callable
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

    def click_figure(self, x_label: str, x: float) -> None:
        """Click a figure at a place of its horizontal axis, in the middle of its height."""
        across, down = self.until(
            f"{x_label} has a frame",
            lambda: self.bokeh(
                """
                const plot = models.find(
                  (m) => m.type === "Figure" && m.below?.[0]?.axis_label === arguments[0]);
                const view = plot && Bokeh.index.find_one(plot);
                if (!view?.el || !shown(view.el)) return null;
                view.el.scrollIntoView({ block: "center" });
                const box = view.el.getBoundingClientRect(), frame = view.frame.bbox;
                return [box.x + view.frame.x_scale.compute(arguments[1]),
                        box.y + (frame.top + frame.bottom) / 2];
                """,
                x_label,
                x,
            ),
        )
        from selenium.webdriver.common.actions.action_builder import ActionBuilder

        mouse = ActionBuilder(self.driver)
        mouse.pointer_action.move_to_location(round(across), round(down)).click()
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
