"""From touches to drive commands, of era-haptics: touch sources, contacts, control loop."""
