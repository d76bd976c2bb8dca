"""The public HTTP port: who may come in, what is handed out, and the WebSocket to Viser."""
