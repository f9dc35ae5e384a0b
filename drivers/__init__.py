"""Amplifiers: drive commands, the guard, the protocol, its codecs and backends."""
