"""Amplifiers, of era-haptics: drive commands, the guard, the protocol, its codecs and backends."""
