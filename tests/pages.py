"""Read a page as a browser does: headings, tables, pictures, links and text."""

import base64
import html.parser

import cv2
import numpy as np


VOID = {"meta", "img", "input"}


class Page(html.parser.HTMLParser):
    """A parsed page, whose elements must be closed in order.

    Attributes:
      tags: all elements in order.
      text: text outside style and SVG.
      headings: texts of headings.
      tables: rows of each table, as texts.
      links: values of `src` and `href`.
      captions: texts of captions.
    """

    def __init__(self, text):
        super().__init__()
        self.tags, self.text, self.headings, self.tables = [], "", [], []
        self.links, self.captions, self._open = [], [], []
        self.feed(text)
        self.close()
        assert not self._open

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        assert not any(name.startswith("on") for name in attributes if name != "oninput")
        self.tags.append(tag)
        self.links += [attributes[name] for name in ("src", "href") if name in attributes]
        if tag not in VOID:
            self._open.append(tag)
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")
        elif tag in ("h1", "h2", "h3"):
            self.headings.append("")
        elif tag == "figcaption":
            self.captions.append("")

    def handle_startendtag(self, tag, attributes):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        inside = self._open[-1] if self._open else ""
        if inside in ("td", "th"):
            self.tables[-1][-1][-1] += data
        elif inside in ("h1", "h2", "h3"):
            self.headings[-1] += data
        elif inside == "figcaption":
            self.captions[-1] += data
        if inside != "style" and "svg" not in self._open:
            self.text += data

    def pictures(self):
        """Decode all pictures; nothing else may be linked."""
        head = "data:image/webp;base64,"
        assert all(link.startswith(head) for link in self.links)
        data = [np.frombuffer(base64.b64decode(link[len(head) :]), np.uint8) for link in self.links]
        return [cv2.imdecode(one, cv2.IMREAD_COLOR) for one in data]
