"""How much of content that people have is felt at one finger, and kept from another."""
