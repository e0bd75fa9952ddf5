// Calls a library of the compiled engine with a problem from a file, on whatever system this is built for (wheels.py).
//
// elsewhere LIBRARY PROBLEM ANSWER. A problem: how many blocks of memory and words of the record there are; the blocks'
// sizes; of each word the block that it points to, or -1, and where to or its value; the blocks. All numbers are int64.
// An answer: the blocks after the call.
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#ifdef _WIN32
#include <windows.h>
static void* function(const char* library) {
  HMODULE module = LoadLibraryA(library);
  return module ? (void*)GetProcAddress(module, "torch_ecc_solve") : NULL;
}
#else
#include <dlfcn.h>
static void* function(const char* library) {
  void* module = dlopen(library, RTLD_NOW);
  return module ? dlsym(module, "torch_ecc_solve") : NULL;
}
#endif

enum { MOST = 64 };

int main(int argc, char** argv) {
  int64_t counts[2], sizes[MOST], words[MOST][2], record[MOST];
  char* blocks[MOST];
  if (argc != 4) return 2;
  int64_t (*solve)(const void*) = (int64_t (*)(const void*))function(argv[1]);
  FILE* file = fopen(argv[2], "rb");
  if (!solve || !file) return 3;
  if (fread(counts, 8, 2, file) != 2 || counts[0] > MOST || counts[1] > MOST) return 4;
  if (fread(sizes, 8, counts[0], file) != (size_t)counts[0]) return 4;
  if (fread(words, 16, counts[1], file) != (size_t)counts[1]) return 4;
  for (int64_t k = 0; k < counts[0]; ++k) {
    blocks[k] = malloc(sizes[k]);
    if (!blocks[k] || fread(blocks[k], 1, sizes[k], file) != (size_t)sizes[k]) return 4;
  }
  for (int64_t k = 0; k < counts[1]; ++k)
    record[k] = words[k][0] < 0 ? words[k][1] : (int64_t)(intptr_t)(blocks[words[k][0]] + words[k][1]);
  printf("%d partial\n", (int)solve(record));
  file = fopen(argv[3], "wb");
  if (!file) return 5;
  for (int64_t k = 0; k < counts[0]; ++k) fwrite(blocks[k], 1, sizes[k], file);
  return fclose(file) ? 5 : 0;
}
