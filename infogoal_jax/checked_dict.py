"""A dict whose entries are checked by whichever way they come in."""

from typing import Any


class CheckedDict(dict):
    """Derive from it and write `check`. What it is made of at first is not checked."""

    def check(self, name: Any, value: Any) -> None:
        """Raise `UserError` for an entry that is none."""
        raise NotImplementedError

    def __setitem__(self, name: Any, value: Any) -> None:
        self.check(name, value)
        super().__setitem__(name, value)

    def update(self, *others: Any, **named: Any) -> None:
        """Add these entries."""
        for name, value in dict(*others, **named).items():
            self[name] = value

    def setdefault(self, name: Any, value: Any = None) -> Any:
        """The entry of this name, which is this value if there was none."""
        if name not in self:
            self[name] = value
        return self[name]

    def __ior__(self, others: Any) -> "CheckedDict":
        self.update(others)
        return self
