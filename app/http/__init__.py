"""The public HTTP port: who may come in, what is handed out, and the WebSocket to Viser.

``server.Front`` puts it together. Every request passes ``auth``; what browsers say to Viser passes
``viser_proxy``, message by message; presses and other changes are ``commands``.
"""
