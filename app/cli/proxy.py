"""The command ``proxy``: what a web server before this one must be told, ready to be copied."""

from __future__ import annotations

from typing import Literal

from onedemo.app.cli.data import Whole

_NGINX = """\
# Both parts belong into the block http, such as a file in /etc/nginx/conf.d.
map $http_upgrade $onedemo_connection {{
    default upgrade;
    ""      "";
}}
server {{
    listen 443 ssl;
    server_name {name};
    ssl_certificate     /etc/letsencrypt/live/{name}/fullchain.pem;
    ssl_certificate_key /etc/letsencrypt/live/{name}/privkey.pem;

    location {path}/ {{
        proxy_pass http://127.0.0.1:{port};                 # without a path behind it
        proxy_http_version 1.1;
        proxy_set_header Upgrade $http_upgrade;             # the live connection is a WebSocket
        proxy_set_header Connection $onedemo_connection;
        proxy_set_header Host $http_host;                   # as the browser sent it, with its port
        proxy_set_header X-Forwarded-For $remote_addr;
        proxy_set_header X-Forwarded-Proto $scheme;
        proxy_read_timeout 1h;
        client_max_body_size 500m;                          # videos
        proxy_request_buffering off;
    }}
}}
"""
_CADDY = """\
{name} {{{redirect}
    reverse_proxy {path}/* 127.0.0.1:{port}
}}
"""


def proxy(
    kind: Literal["nginx", "caddy"], /, *, host_name: str, base_path: str = "", port: Whole = 8080
) -> None:
    """Lines for a proxy that speaks TLS with people, and how to start the server behind it.

    Args:
        kind: Which proxy.
        host_name: The name that people use, such as study.example.org.
        base_path: The path that the study has there, such as /study1.
        port: Of the server on this machine.
    """
    from onedemo.app.network.bind import Listening

    base_path = base_path.rstrip("/")
    Listening(names=(host_name,), base_path=base_path)  # says what is wrong with them
    options = f"--behind-proxy --allow-host {host_name}"
    options += f" --base-path {base_path}" if base_path else ""
    options += f" --port {port}" if port != 8080 else ""
    print(f"# Start the server with: onedemo serve {options}")
    text = _NGINX if kind == "nginx" else _CADDY
    redirect = f"\n    redir {base_path} {base_path}/" if base_path else ""
    print(text.format(name=host_name, path=base_path, port=port, redirect=redirect), end="")
