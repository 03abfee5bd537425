"""Extensions of griffe for the API pages."""

from typing import Any

import griffe

LONG_VALUE = 200


class NewIsInit(griffe.Extension):
    """Shows `__new__`, as classes of the extension have it, as the signature of a class."""

    def on_class_members(self, *, cls: griffe.Class, **_: Any) -> None:  # noqa: ANN401  # as griffe declares it
        """Give the class an `__init__` of the same parameters."""
        new = cls.members.get("__new__")
        if isinstance(new, griffe.Function) and "__init__" not in cls.members:
            init = griffe.Function("__init__", parameters=new.parameters, returns=None, lineno=new.lineno)
            cls.set_member("__init__", init)


class ShortValues(griffe.Extension):
    """Shows no value that is longer than a few lines."""

    def on_attribute(self, *, attr: griffe.Attribute, **_: Any) -> None:  # noqa: ANN401  # as griffe declares it
        """Leave a long value out."""
        if len(str(attr.value)) > LONG_VALUE:
            attr.value = None
