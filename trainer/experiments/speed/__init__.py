"""Speed, part by part, each side by side with a peer or with the machine's limit."""
