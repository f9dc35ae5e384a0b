"""The control loop: from contacts to command sets, and the loop that sends them."""
