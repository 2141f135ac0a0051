"""XML documents whose elements know where they stand, also those that are copied."""

from __future__ import annotations

from typing import NamedTuple

KEY = "line"


class Line(NamedTuple):
    """Where an element stands: file, line, and the tag that it had there."""

    file: str
    line: int
    tag: str


def parse_with_lines(xml: bytes, file: str):
    """Return the document of an XML file, for `line_of`; document types and entities are refused.

    Raises
    ------
    xml.parsers.expat.ExpatError
        if the XML is broken.
    defusedxml.DefusedXmlException
        if it declares a document type or entities.

    >>> document = parse_with_lines(b"<a>\\n<b/></a>", "a.xml")
    >>> line_of(document.documentElement.lastChild.cloneNode(deep=True))
    Line(file='a.xml', line=2, tag='b')
    """
    from defusedxml.expatbuilder import DefusedExpatBuilderNS

    builder = DefusedExpatBuilderNS(forbid_dtd=True)
    start = builder.start_element_handler

    def start_with_line(name, attributes):
        start(name, attributes)
        element = builder.curNode
        line = Line(file, builder.getParser().CurrentLineNumber, element.tagName)
        element.setUserData(KEY, line, _ToCopies)

    builder.start_element_handler = start_with_line
    return builder.parseString(xml)


def line_of(element) -> Line | None:
    """Return where an element stands; None of anything else, and of elements from elsewhere."""
    return element.getUserData(KEY) if hasattr(element, "getUserData") else None


class _ToCopies:
    """A handler of the DOM that gives copies the line of the element."""

    @staticmethod
    def handle(_operation, key, data, _source, copy):
        copy.setUserData(key, data, _ToCopies)
