"""Settings of the console."""

from dataclasses import dataclass

from sextant.shared.files import config

_LOOPBACK = ("127.0.0.1", "::1", "localhost")
_MIN_TOKEN_LENGTH = 16  # minimum length of a token [characters]


@dataclass(frozen=True, slots=True)
class Settings:
    """Address of the web server, and initial walking parameters of a page."""

    host: str = "127.0.0.1"  # to listen on; any address outside loopback is open to the network and requires a token
    port: int = 8080
    token: str = ""  # that a browser must give, as http://host:port/#token; optional on a loopback address
    body_height: float = 0.0  # [m] initial height of the body over the floor; 0 selects the profile's height
    lift: float = 0.04  # [m] initial clearance of swinging feet

    checks = (
        *config.each("host", lambda host: host.strip() != "", "an address to listen on, e.g. 127.0.0.1"),
        *config.each("port", lambda port: 0 <= port <= 65535, "a TCP port from 0 (any free port) to 65535"),
        *config.each(
            "token",
            lambda token: token == "" or len(token) >= _MIN_TOKEN_LENGTH,
            f"at least {_MIN_TOKEN_LENGTH} characters, or none",
        ),
        *config.each("lift", lambda lift: 0.0 < lift <= 0.2, "more than 0 and at most 0.2 m"),
        *config.each("body_height", lambda height: 0.0 <= height <= 0.5, "0 to 0.5 m"),
        config.together(
            "host token",
            lambda host, token: host in _LOOPBACK or token != "",
            "a token for an address that other computers reach, or 127.0.0.1 (remote access: ssh -L 8080:127.0.0.1:8080 ROBOT)",
        ),
    )

    def __post_init__(self) -> None:
        config.verify(self)

    def url(self, port: int) -> str:
        """Return the URL of the page that is served on a port, including the token."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{port}/" + (f"#{self.token}" if self.token else "")
