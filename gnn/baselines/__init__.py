"""The rivals: Kipf's NRI and its decoder, LSTM, Seq2Seq."""
