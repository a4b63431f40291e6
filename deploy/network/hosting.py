"""Hosts a router behind its TLS proxy."""

import contextlib
from collections.abc import Callable, Iterator

from deploy.launch.launcher import free_port
from deploy.network.gate import Gate
from deploy.network.tls_proxy import TlsProxy
from shared.access import Keys
from shared.transport import Router


@contextlib.contextmanager
def hosted(gated: Gate, refuse: Callable[[str], object] = lambda _kind: None) -> Iterator[Router]:
    """Host a router; other machines meet it through a TLS proxy.

    Args:
        gated: Where it listens, and whom it lets in.
        refuse: Is called with the kind of each refusal of the proxy, from another thread.

    Raises:
        TransportError: An endpoint cannot be listened on.
        AccessError: The keys are wrong.
    """
    with contextlib.ExitStack() as stack:
        port = free_port() if gated.secure else 0
        if gated.secure and gated.keys is not None:
            stack.enter_context(TlsProxy(gated.secure, Keys.load(gated.keys), port, refuse))
        yield stack.enter_context(Router(gated.behind_proxy(port), gated.upstream, gated.configuration()))
