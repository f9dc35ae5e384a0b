"""The daemon's API: JSON-RPC 2.0 over a Unix socket; messages, server and clients."""
