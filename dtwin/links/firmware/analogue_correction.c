/* Analogue correction of three axes: frames on the serial port in, voltages out.
 *
 * Board: ATmega328P at 16 MHz (Arduino Uno class) with an AD5754R, a 16-bit DAC of four channels,
 * on SPI: SYNC = PB2 (D10), LDAC = PB1 (D9), SDIN = PB3, SDO = PB4, SCLK = PB5; output range 0 to
 * 10 V. Without that chip: 8-bit pulse widths on D6, D5 and D3 for 0-10 V converters, as a mode.
 *
 * Whatever stops - host, line, this program - the outputs go to their neutral codes, which stand for
 * no correction: after a command timeout here, after a hang by the chip's own watchdog and start-up.
 *
 * No interrupts: one loop, and no step of it lasts longer than the two bytes that the port can hold.
 *
 * Tried in simavr with a model of the DAC written from its data sheet; not yet run on a board.
 */
#include <avr/eeprom.h>
#include <avr/io.h>
#include <avr/wdt.h>
#include <string.h>

#ifndef BAUD
#define BAUD 250000UL
#endif
#define AXES 3
#define PROTOCOL 1

/* Commands, first byte of a payload. */
enum { STATUS, SET, ENGAGE, RELEASE, NEUTRAL };
/* Flags of an answer. */
enum {
    ENGAGED = 1, TRIPPED = 2, PWM_MODE = 4, READ_BACK_WRONG = 8, NOT_ENGAGED = 16, STALE = 32,
    UNKNOWN = 64
};
/* Arguments of ENGAGE: output, timeout in ms. */
enum { OUTPUT_DAC, OUTPUT_PWM };

#define DEFAULT_TIMEOUT_MS 20
#define MIN_TIMEOUT_MS 2
#define MAX_TIMEOUT_MS 1000
#define MIDDLE 32768U
#define MAGIC 0xD7A1U

typedef struct {
    uint8_t command;
    uint16_t argument[AXES];
} __attribute__((packed)) request_t;

typedef struct {
    uint8_t command;
    uint8_t flags;
    uint16_t applied[AXES];
    uint16_t bad_frames;
    uint16_t trips;
} __attribute__((packed)) answer_t;

typedef struct {
    uint16_t magic;
    uint16_t neutral[AXES];
    uint16_t crc;
} stored_t;

#define HEAD 3
#define CRC_SIZE 2
#define REQUEST_FRAME (HEAD + sizeof(request_t) + CRC_SIZE)
#define ANSWER_FRAME (HEAD + sizeof(answer_t) + CRC_SIZE)

static EEMEM stored_t stored;
static uint16_t neutral[AXES] = {MIDDLE, MIDDLE, MIDDLE};
static uint16_t wanted[AXES], applied[AXES];
static uint16_t bad_frames, trips, last_sequence;
static uint8_t engaged, tripped, pwm, read_back_wrong, seen_any;
static uint16_t timeout_ms = DEFAULT_TIMEOUT_MS;
static uint16_t silent_ms;

/* ---- serial port: polled from everywhere, so that the line never waits -------------------------- */
#define RING 128
static uint8_t in_ring[RING], out_ring[RING];
static uint8_t in_head, in_tail, out_head, out_tail;

static void serve_port(void) {
    uint8_t status = UCSR0A, next;
    if (status & _BV(RXC0)) {
        next = (in_head + 1) % RING;
        in_ring[in_head] = UDR0;
        if (next != in_tail) {
            in_head = next;
        }
    }
    if ((status & _BV(UDRE0)) && out_tail != out_head) {
        UDR0 = out_ring[out_tail];
        out_tail = (out_tail + 1) % RING;
    }
}

static void put(uint8_t byte) {
    uint8_t next = (out_head + 1) % RING;
    while (next == out_tail) {
        serve_port();
    }
    out_ring[out_head] = byte;
    out_head = next;
    serve_port();
}

/* ---- outputs ------------------------------------------------------------------------------- */
static uint8_t spi(uint8_t byte) {
    SPDR = byte;
    while (!(SPSR & _BV(SPIF))) {
    }
    return SPDR;
}

static uint16_t dac(uint8_t head, uint16_t value) {
    uint16_t back;
    PORTB &= ~_BV(PB2);
    spi(head);
    back = (uint16_t)spi(value >> 8) << 8;
    back |= spi(value & 0xFF);
    PORTB |= _BV(PB2);
    serve_port();
    return back;
}

static void dac_begin(void) {
    dac(0x0C, 0x0001); /* output range of all channels: 0 to 10 V */
    dac(0x10, 0x000F); /* power up A to D */
}

static void dac_write(void) {
    uint8_t i;
    for (i = 0; i < AXES; i++) {
        dac(i, wanted[i]);
    }
    PORTB &= ~_BV(PB1); /* all channels change at once */
    PORTB |= _BV(PB1);
    read_back_wrong = 0;
    for (i = 0; i < AXES; i++) {
        dac(0x80 | i, 0);
        applied[i] = dac(0x18, 0);
        read_back_wrong |= applied[i] != wanted[i];
    }
}

static uint8_t eight_bits(uint16_t code) { return code > 0xFF7F ? 0xFF : (code + 0x80) >> 8; }

static void pwm_write(void) {
    uint8_t i;
    OCR0A = eight_bits(wanted[0]);
    OCR0B = eight_bits(wanted[1]);
    OCR2B = eight_bits(wanted[2]);
    applied[0] = (uint16_t)OCR0A << 8;
    applied[1] = (uint16_t)OCR0B << 8;
    applied[2] = (uint16_t)OCR2B << 8;
    read_back_wrong = 0;
    for (i = 0; i < AXES; i++) {
        read_back_wrong |= (applied[i] >> 8) != eight_bits(wanted[i]);
    }
}

static void write_outputs(const uint16_t *codes) {
    memcpy(wanted, codes, sizeof wanted);
    if (pwm) {
        pwm_write();
    } else {
        dac_write();
    }
}

static void go_neutral(void) {
    engaged = 0;
    write_outputs(neutral);
}

/* ---- neutral codes, kept without power ------------------------------------------------------- */
/* CRC-16/CCITT-FALSE, four bits at a time. */
static const uint16_t crc_table[16] = {0x0000, 0x1021, 0x2042, 0x3063, 0x4084, 0x50A5,
                                       0x60C6, 0x70E7, 0x8108, 0x9129, 0xA14A, 0xB16B,
                                       0xC18C, 0xD1AD, 0xE1CE, 0xF1EF};

static uint16_t crc_of(const uint8_t *data, uint8_t n) {
    uint16_t crc = 0xFFFF;
    for (; n--; data++) {
        crc = crc << 4 ^ crc_table[(crc >> 12) ^ (*data >> 4)];
        crc = crc << 4 ^ crc_table[(crc >> 12) ^ (*data & 15)];
        serve_port();
    }
    return crc;
}

static void load_neutral(void) {
    stored_t found;
    eeprom_read_block(&found, &stored, sizeof found);
    if (found.magic == MAGIC && found.crc == crc_of((uint8_t *)&found, sizeof found - CRC_SIZE)) {
        memcpy(neutral, found.neutral, sizeof neutral);
    }
}

static void store_neutral(void) {
    stored_t kept = {.magic = MAGIC};
    memcpy(kept.neutral, neutral, sizeof neutral);
    kept.crc = crc_of((uint8_t *)&kept, sizeof kept - CRC_SIZE);
    eeprom_update_block(&kept, &stored, sizeof kept);
}

/* ---- frames: version, sequence, payload, CRC-16, stuffed so that zero ends them (COBS) ---------- */
static void answer(uint16_t sequence, uint8_t command, uint8_t extra) {
    uint8_t body[ANSWER_FRAME], i, start;
    answer_t *a = (answer_t *)(body + HEAD);
    uint16_t crc;
    body[0] = PROTOCOL;
    memcpy(body + 1, &sequence, sizeof sequence);
    a->command = command;
    a->flags = extra | (engaged ? ENGAGED : 0) | (tripped ? TRIPPED : 0) | (pwm ? PWM_MODE : 0) |
               (read_back_wrong ? READ_BACK_WRONG : 0);
    memcpy(a->applied, applied, sizeof applied);
    a->bad_frames = bad_frames;
    a->trips = trips;
    crc = crc_of(body, ANSWER_FRAME - CRC_SIZE);
    memcpy(body + ANSWER_FRAME - CRC_SIZE, &crc, sizeof crc);
    for (start = 0; start <= ANSWER_FRAME; start = i + 1) {
        for (i = start; i < ANSWER_FRAME && body[i]; i++) {
        }
        put(i - start + 1);
        while (start < i) {
            put(body[start++]);
        }
    }
    put(0);
}

static uint8_t unstuff(uint8_t *data, uint8_t n) {
    uint8_t at = 0, out = 0, length, i;
    while (at < n) {
        length = data[at++];
        if (length == 0 || at + length - 1 > n) {
            return 0;
        }
        for (i = 1; i < length; i++) {
            data[out++] = data[at++];
        }
        if (length < 0xFF && at < n) {
            data[out++] = 0;
        }
    }
    return out;
}

static void obey(uint16_t sequence, const request_t *r) {
    uint8_t extra = 0, fresh = !seen_any || (uint16_t)(sequence - last_sequence - 1) < 0x7FFF;
    switch (r->command) {
    case STATUS:
        break;
    case SET:
        if (!engaged) {
            extra = NOT_ENGAGED;
        } else if (!fresh) {
            extra = STALE;
        } else {
            silent_ms = 0;
            write_outputs(r->argument);
        }
        break;
    case ENGAGE:
        pwm = r->argument[0] == OUTPUT_PWM;
        timeout_ms = r->argument[1] < MIN_TIMEOUT_MS   ? MIN_TIMEOUT_MS
                     : r->argument[1] > MAX_TIMEOUT_MS ? MAX_TIMEOUT_MS
                                                       : r->argument[1];
        silent_ms = 0;
        fresh = 1; /* a host that opened the port again counts from zero */
        go_neutral();
        tripped = 0;
        engaged = 1;
        break;
    case RELEASE:
        go_neutral();
        tripped = 0;
        break;
    case NEUTRAL:
        memcpy(neutral, r->argument, sizeof neutral);
        store_neutral();
        go_neutral();
        break;
    default:
        extra = UNKNOWN;
    }
    if (fresh) {
        last_sequence = sequence;
        seen_any = 1;
    }
    answer(sequence, r->command, extra);
}

static void take(uint8_t byte) {
    static uint8_t pending[REQUEST_FRAME + 2], n, overlong;
    uint16_t sequence, crc;
    if (byte) {
        if (n < sizeof pending) {
            pending[n++] = byte;
        } else {
            overlong = 1;
        }
        return;
    }
    if (n || overlong) {
        if (!overlong && unstuff(pending, n) == REQUEST_FRAME && pending[0] == PROTOCOL) {
            memcpy(&crc, pending + REQUEST_FRAME - CRC_SIZE, sizeof crc);
            if (crc == crc_of(pending, REQUEST_FRAME - CRC_SIZE)) {
                memcpy(&sequence, pending + 1, sizeof sequence);
                obey(sequence, (request_t *)(pending + HEAD));
                n = 0;
                return;
            }
        }
        bad_frames++;
    }
    n = overlong = 0;
}

int main(void) {
    MCUSR = 0;
    wdt_disable();
    DDRB |= _BV(PB1) | _BV(PB2) | _BV(PB3) | _BV(PB5);
    PORTB |= _BV(PB1) | _BV(PB2);
    DDRD |= _BV(PD3) | _BV(PD5) | _BV(PD6);
    SPCR = _BV(SPE) | _BV(MSTR) | _BV(CPHA); /* mode 1, 8 MHz */
    SPSR = _BV(SPI2X);
    TCCR0A = _BV(COM0A1) | _BV(COM0B1) | _BV(WGM01) | _BV(WGM00);
    TCCR0B = _BV(CS00);
    TCCR2A = _BV(COM2B1) | _BV(WGM21) | _BV(WGM20);
    TCCR2B = _BV(CS20);
    OCR0A = OCR0B = OCR2B = 0x80;
    load_neutral();
    dac_begin();
    go_neutral();
    TCCR1B = _BV(WGM12) | _BV(CS11); /* 2 MHz */
    OCR1A = 1999;
    UCSR0A = _BV(U2X0);
    UBRR0 = F_CPU / (8 * BAUD) - 1;
    UCSR0B = _BV(RXEN0) | _BV(TXEN0);
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    wdt_enable(WDTO_60MS);
    for (;;) {
        wdt_reset();
        serve_port();
        if (in_tail != in_head) {
            uint8_t byte = in_ring[in_tail];
            in_tail = (in_tail + 1) % RING;
            take(byte);
        }
        if (TIFR1 & _BV(OCF1A)) {
            TIFR1 = _BV(OCF1A);
            silent_ms += silent_ms < UINT16_MAX;
            if (engaged && silent_ms >= timeout_ms) {
                go_neutral();
                tripped = 1;
                trips++;
            }
        }
    }
}
