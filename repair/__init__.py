"""How is the law made safe? Networks as mixed-integer programs, solved, verified, certified; nothing is here yet."""
