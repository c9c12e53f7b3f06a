"""Leads a guided capture's person by a page in a browser."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from udccal.cli.output import Output
from udccal.guide.events import Person
from udccal.rig import RigDescription
from udccal.web.page import serve
from udccal.web.person import WebPerson
from udccal.web.picture import Sampling


@contextmanager
def web_person(output: Output, rig: RigDescription, port: int) -> Iterator[Person]:
    """Serve the page of a guided capture while the context lasts; print its address and yield who is led.

    Args:
        output: prints the address.
        rig: whose camera is seen.
        port: to listen on; 0 for any that is free.

    Raises:
        UdccalError: when the port cannot be had.
    """
    person = WebPerson(Sampling.of(rig))
    with serve(person, port) as address:
        output.say(f"Open this address in a browser of this computer:\n{address}")
        yield person
