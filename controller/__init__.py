"""From touches to drive commands: touch sources, contacts, selection, routing, control loop."""
