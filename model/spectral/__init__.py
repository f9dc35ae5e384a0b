"""The plate in Legendre polynomials over its whole length and width, without elements."""
