"""What people measure, judge and design with: it imports all other packages, none imports it."""
