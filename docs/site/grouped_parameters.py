"""An extension of griffe, which reads the docstrings for the site: parameters described together get their own types."""

import re
from typing import Any

import griffe

GROUP = re.compile(r"^(\*{0,2}\w+(?:, \*{0,2}\w+)+)\n((?:[ ]{4,}\S.*\n?)+)", re.MULTILINE)  # names without a type, indented lines


class GroupedParameters(griffe.Extension):
    """Give each name of an entry `a, b` without a type an entry of its own. griffe gives all of them the type of `a`."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        if obj.docstring:
            obj.docstring.value = GROUP.sub(lambda entry: "".join(f"{name}\n{entry[2].rstrip()}\n" for name in entry[1].split(", ")),
                                            obj.docstring.value)
