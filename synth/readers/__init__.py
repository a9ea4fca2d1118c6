"""What reads captures and decides no byte of them."""
