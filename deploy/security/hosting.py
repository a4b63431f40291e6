"""Host a router between its TLS proxies.

Other machines connect to it through one of them; it connects to other routers through the other.
"""

import contextlib
from collections.abc import Callable, Iterator

from sextant.deploy.security.router_security import Gate
from sextant.deploy.security.tls_dialer import TlsDialer
from sextant.deploy.security.tls_proxy import TlsProxy
from sextant.shared.wire.access import Keys
from sextant.shared.wire.ports import free_port
from sextant.shared.wire.transport import Router, merged

_DIALLED_MS = 30_000  # [ms] the router's timeout for a dialer, which ends each attempt long before


@contextlib.contextmanager
def hosted(gated: Gate, refuse: Callable[[str], object] = lambda _kind: None) -> Iterator[Router]:
    """Host a router; other machines connect to it through a TLS proxy.

    Args:
        gated: Its endpoints and access policy.
        refuse: Called with the kind of each refusal of the proxy, from another thread.

    Raises:
        TransportError: An endpoint cannot be listened on.
        NoFreePortError: No port of this machine is free.
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
    """Return the endpoint at which the router connects to another machine's router.

    If the other one asks for certificates, this is a dialer on this machine.
    """
    if not endpoint.startswith("tls/"):
        return endpoint
    return keys.to_dialer(stack.enter_context(TlsDialer(endpoint, keys)).port)
