"""Web page for operators: scans, health and history over HTTP and a WebSocket."""
