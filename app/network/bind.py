"""Where the front listens, and under which names it may be spoken to."""

from __future__ import annotations

import ipaddress
import re
import socket
import ssl
from dataclasses import dataclass
from pathlib import Path

from aiohttp import web

from onedemo.errors import UserError

_HOST_NAME = re.compile(r"(?=.{1,253}$)[a-z0-9]([a-z0-9-]*[a-z0-9])?(\.[a-z0-9]([a-z0-9-]*[a-z0-9])?)*")

_BASE_PATH = re.compile(r"(?=.{0,100}$)(/[A-Za-z0-9_-]+)*")


@dataclass(frozen=True, kw_only=True)
class Listening:
    """Address, encryption and names.

    Raises:
        UserError: If strangers could listen in: an address that other machines reach, without TLS and
            without a proxy that has it; or if half of a pair of files is missing.
    """

    host: str = "127.0.0.1"
    port: int = 8080
    """0 takes a free one."""
    tls_cert: Path | None = None
    """Certificate chain, PEM."""
    tls_key: Path | None = None
    """Its private key, PEM."""
    behind_proxy: bool = False
    """A proxy speaks TLS with people, and is the only one that can reach this address. It is believed
    who asks (the last of X-Forwarded-For) and how (X-Forwarded-Proto)."""
    names: tuple[str, ...] = ()
    """Host names that people use, besides this machine's numbers and localhost."""
    base_path: str = ""
    """What all addresses begin with, such as /study1, where a proxy gives the study a path alone."""

    def __post_init__(self) -> None:
        if (self.tls_cert is None) != (self.tls_key is None):
            raise UserError("--tls-cert and --tls-key go together: give both, or neither")
        if not (is_loopback(self.host) or self.tls_cert or self.behind_proxy):
            raise UserError(
                f"--host {self.host} lets other machines in, and without TLS they can read along: give "
                "--tls-cert and --tls-key, or put a proxy that speaks TLS before it and say --behind-proxy"
            )
        for name in self.names:
            if not _HOST_NAME.fullmatch(name.lower()):
                raise UserError(
                    f"--allow-host takes a host name such as study.example.org, got {name[:80]!a}"
                )
        if not _BASE_PATH.fullmatch(self.base_path):
            raise UserError(
                f"--base-path takes a path such as /study1, of letters, digits, - and _, "
                f"got {self.base_path[:80]!a}"
            )

    def ssl_context(self) -> ssl.SSLContext | None:
        """What encrypts; None if nothing does.

        Raises:
            UserError: If certificate or key cannot be used.
        """
        if self.tls_cert is None or self.tls_key is None:
            return None
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        try:
            context.load_cert_chain(self.tls_cert, self.tls_key)
        except (OSError, ssl.SSLError) as error:
            raise UserError(
                f"cannot use the certificate {self.tls_cert} with the key {self.tls_key}: {error}"
            ) from None
        return context

    def address(self, port: int) -> str:
        """Where people find the page: ``https://study.example.org/study1``, without a slash at its end.

        Args:
            port: That is open.
        """
        if self.behind_proxy and self.names:  # it is the proxy that people speak to
            return f"https://{self.names[0]}{self.base_path}"
        scheme, usual = ("https", 443) if self.tls_cert else ("http", 80)
        host = "127.0.0.1" if self.host in ("", "0.0.0.0", "::") else self.host
        host = self.names[0] if self.names else f"[{host}]" if ":" in host else host
        return f"{scheme}://{host}{'' if port == usual else f':{port}'}{self.base_path}"

    def page_path(self, rater: int) -> str:
        """Path of a person's page; all that it uses lies below."""
        return f"{self.base_path}/r/{rater}/"

    def knows(self, host: str) -> bool:
        """Whether a request may name this host: a number, localhost, or a name that was allowed.

        A page of a stranger whose name leads to this machine (DNS rebinding) sends that name.

        Args:
            host: The Host header, with or without a port.
        """
        found = re.fullmatch(r"(\[[0-9A-Fa-f:.]+\]|[^:\[\]]+)(:\d{1,5})?", host)
        if found is None:
            return False
        name = found[1].strip("[]").lower().rstrip(".")
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return name == "localhost" or name in {allowed.lower() for allowed in self.names}
        return True

    def client(self, request: web.BaseRequest) -> str:
        """The address of who asks."""
        if self.behind_proxy:
            # Whoever asks may send lines of their own; the proxy's word is the last of the last.
            last = ",".join(request.headers.getall("X-Forwarded-For", ())).rsplit(",", 1)[-1]
            if (address := read_address(last)) is not None:
                return str(address)
        return request.remote or "unknown"

    def sender(self, request: web.BaseRequest) -> str:
        """Who asks, as far as limits are counted: the address, or its network."""
        return network(self.client(request))

    def encrypted(self, request: web.BaseRequest) -> bool:
        """Whether the way to the browser is encrypted: cookies then never go another way."""
        if self.behind_proxy:
            return request.headers.get("X-Forwarded-Proto", "").lower() == "https"
        return request.secure


def read_address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """An address as proxies write it, with or without a port and brackets; None if it is none."""
    text = text.strip()
    for form in (r"\[([0-9A-Fa-f:.]+)\](?::\d{1,5})?", r"(\d+\.\d+\.\d+\.\d+):\d{1,5}", r"(.+)"):
        if found := re.fullmatch(form, text, re.ASCII):
            try:
                address = ipaddress.ip_address(found[1])
            except ValueError:
                return None
            return getattr(address, "ipv4_mapped", None) or address
    return None


def network(address: str) -> str:
    """What counts as one sender: an IPv4 address, or the /64 that one line has of IPv6."""
    known = read_address(address.partition("%")[0])
    if isinstance(known, ipaddress.IPv6Address):
        return str(ipaddress.ip_network((known, 64), strict=False))
    return address if known is None else str(known)


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches an address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check_port(host: str, port: int) -> None:
    """Raises UserError if the port cannot be opened now; to be called before anything is written."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except (OSError, OverflowError, UnicodeError) as error:
        raise not_opened(error, host, port) from None


def not_opened(error: BaseException, host: str, port: int) -> UserError:
    """Why a port cannot be opened, in words."""
    if isinstance(error, OSError) and error.errno in (98, 48, 10048):
        return UserError(f"port {port} on {host} is in use; choose another with --port")
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return UserError(f"port {port} on {host} cannot be opened ({reason}); choose another with --port")
