/* Counts the frames of `udccal run --sink shm:NAME`; docs/live.md has the layout. cc -O2 -o read_live read_live.c */
#include <fcntl.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

struct header { /* constant but for the last two */
    char magic[8];
    uint32_t version, header_bytes, width, height, stride, format, slots, edge_bytes;
    uint64_t slot_bytes, first_slot, newest, closed;
};

static uint64_t word(const char *place) { return __atomic_load_n((const uint64_t *)place, __ATOMIC_ACQUIRE); }

int main(int count, char **words) {
    char path[128];
    struct stat size;
    snprintf(path, sizeof path, "/%s", count > 1 ? words[1] : "");
    int file = shm_open(path, O_RDONLY, 0);
    if (file < 0 || fstat(file, &size) != 0) return perror("shm_open"), 1;
    const char *memory = mmap(NULL, size.st_size, PROT_READ, MAP_SHARED, file, 0);
    const struct header *header = (const struct header *)memory;
    if (memory == MAP_FAILED || memcmp(header->magic, "UDCCALFR", 8) != 0 || header->version != 1)
        return fprintf(stderr, "expected frames of udccal, version 1, found something else\n"), 1;
    size_t bytes = (size_t)header->stride * header->height;
    unsigned char *picture = malloc(bytes);
    for (uint64_t seen = 0, waited = 0; !word((const char *)&header->closed);) {
        uint64_t newest = word((const char *)&header->newest);
        if (newest == seen) { /* the writer locks the memory for as long as it lives */
            usleep(1000);
            if (++waited % 250 != 0 || flock(file, LOCK_SH | LOCK_NB) != 0 || word((const char *)&header->closed)) continue;
            return fprintf(stderr, "expected the writer to live, found that it was killed; start it again\n"), 1;
        }
        const char *slot = memory + header->first_slot + (newest - 1) % header->slots * header->slot_bytes;
        uint64_t last = word(slot + header->slot_bytes - header->edge_bytes); /* first of all */
        memcpy(picture, slot + header->edge_bytes, bytes);
        uint64_t frame_id = word(slot + 8);
        __atomic_thread_fence(__ATOMIC_ACQUIRE);
        int whole = last == newest && word(slot) == newest; /* last of all */
        uint64_t sum = 0;
        for (size_t i = 0; i < bytes; i++) sum += picture[i];
        if (whole) printf("frame %llu: mean %.2f\n", (unsigned long long)frame_id, (double)sum / bytes);
        else printf("frame %llu: torn\n", (unsigned long long)frame_id);
        fflush(stdout);
        seen = newest, waited = 0;
    }
    return 0;
}
