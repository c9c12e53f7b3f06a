/* Counts the frames of `udccal run --sink shm:NAME`; docs/live.md has the layout. cc -O2 -o read_live read_live.c */
#include <err.h>
#include <inttypes.h>
#include <stdio.h>
#include <string.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>
#define WORD(byte) __atomic_load_n((const uint64_t *)(memory + (byte)), __ATOMIC_ACQUIRE)

int main(int count, char **words) {
    struct stat size;
    int file = shm_open(count > 1 ? words[1] : "", O_RDONLY, 0);
    if (file < 0 || fstat(file, &size) != 0) err(1, "shm_open");
    const char *memory = mmap(NULL, size.st_size, PROT_READ, MAP_SHARED, file, 0);
    const uint32_t *header = (const uint32_t *)memory; /* [5] rows, [6] stride, [8] slots, [9] bytes of a slot's edge */
    if (memory == MAP_FAILED || memcmp(memory, "UDCCALFR\1\0\0", 12)) errx(1, "expected udccal's frames, version 1");
    for (uint64_t seen = 0, newest, sum, bytes = (uint64_t)header[5] * header[6]; !WORD(64); seen = newest) {
        while ((newest = WORD(56)) == seen && !WORD(64) && usleep(1000) == 0) /* the writer holds a lock till it ends */
            if (!flock(file, LOCK_SH | LOCK_NB) && !WORD(64)) errx(1, "expected a writer, found that it was killed");
        if (newest == seen) break;
        uint64_t slot = WORD(48) + (newest - 1) % header[8] * WORD(40), last = WORD(slot + WORD(40) - header[9]);
        printf("frame %" PRIu64 ": ", WORD(slot + 8));
        for (uint64_t i = sum = 0; i < bytes; i++) sum += (unsigned char)memory[slot + header[9] + i];
        __atomic_thread_fence(__ATOMIC_ACQUIRE); /* the slot's end is read first, its beginning last */
        printf(last == newest && WORD(slot) == newest ? "mean %.2f\n" : "torn\n", (double)sum / bytes);
        fflush(stdout);
    }
}
