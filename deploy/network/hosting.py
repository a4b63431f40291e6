"""Hosts a router between its TLS proxies: other machines meet it through one, it meets others through the other."""

import contextlib
from collections.abc import Callable, Iterator

from sextant.deploy.launch.launcher import free_port
from sextant.deploy.network.gate import Gate
from sextant.deploy.network.tls_dialer import TlsDialer
from sextant.deploy.network.tls_proxy import TlsProxy
from sextant.shared.wire.access import Keys
from sextant.shared.wire.transport import Router, merged

_DIALLED_MS = 30_000  # [ms] that the router waits for a dialer, which ends each attempt long before


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
        listen, upstream, configuration = gated.listen, gated.upstream, dict(gated.configuration())
        if gated.keys is not None:
            keys, port = Keys.load(gated.keys), free_port()
            listen = gated.behind_proxy(port)
            if gated.secure:
                stack.enter_context(TlsProxy(gated.secure, keys, port, refuse))
            upstream = tuple(_dialled(stack, endpoint, keys) for endpoint in gated.upstream)
            if upstream and all(endpoint.startswith("tls/") for endpoint in upstream):
                configuration = merged(configuration, {"transport": {"unicast": {"open_timeout": _DIALLED_MS}}})
        yield stack.enter_context(Router(listen, upstream, configuration))


def _dialled(stack: contextlib.ExitStack, endpoint: str, keys: Keys) -> str:
    """Return where the router connects to another's: at a dialer of this machine, where the other asks for certificates."""
    if not endpoint.startswith("tls/"):
        return endpoint
    return keys.to_dialer(stack.enter_context(TlsDialer(endpoint, keys)).port)
