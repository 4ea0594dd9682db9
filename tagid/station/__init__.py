"""A page to work at: scans, health and history over HTTP and a WebSocket, for a browser beside the table."""
