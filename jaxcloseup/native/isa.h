// Names of what is compiled once for each instruction set, which ISA names.
//
// Nothing of the standard library may be instantiated in such a file: the linker would keep one
// copy for all processors.
#pragma once

#ifndef ISA
#define ISA baseline
#endif
#define NAMED(prefix, isa) prefix##isa
#define OF_ISA(prefix, isa) NAMED(prefix, isa)
#define STRING(name) #name
#define NAME(name) STRING(name)
