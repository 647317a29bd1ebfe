"""Steps of integrations: methods, their control, and ends where elements switch."""
