"""The file of a passport, ``"trainlog/passport"``, attached to the log of its trip."""

from __future__ import annotations

from pathlib import Path

from trainlog.formats.declared import thing_from_bytes, thing_to_bytes
from trainlog.railway.passport import Passport


def passport_from_bytes(data: bytes, *, file: str | Path = "passport.json") -> Passport:
    """The passport in the bytes of its file; `file` is what errors call it.

    Examples
    --------
    >>> passport_from_bytes(b"")
    Traceback (most recent call last):
    trainlog.errors.InputError: passport.json: is empty; expected JSON
    """
    return thing_from_bytes(Passport, data, file)


def passport_to_bytes(passport: Passport) -> bytes:
    """The bytes of the passport's file: doubles exact, the same passport gives the same bytes.

    Examples
    --------
    >>> from trainlog.railway.passport import Quantity
    >>> unknown = Quantity(float("nan"), float("nan"), "assumed", "no efforts recorded")
    >>> passport = Passport("trip 1", *6 * [unknown])
    >>> passport_from_bytes(passport_to_bytes(passport)).effort_gain.reason
    'no efforts recorded'
    """
    return thing_to_bytes(passport)
