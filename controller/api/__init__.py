"""The daemon's API: JSON-RPC 2.0 over a Unix socket; what is said, who serves it, and clients."""
